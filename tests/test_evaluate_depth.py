"""Depth error by method: the truth is the best there is, and failures are counted."""

from __future__ import annotations

import csv
import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from planes import along_x, plane_pair, turned
from scipy.spatial.transform import Rotation
from tiny_network import road_set

from flowrect.depth import STEREO, StereoMatcher, hitnet_weights, load_stereo
from flowrect.depth_error import DepthSamples, comparable, matched
from flowrect.evaluate_depth import PRIOR, Tally, comparisons, main, rectified_by
from flowrect.evaluation import one_page, stamp
from flowrect.evaluation.delivered import Delivery
from flowrect.evaluation.depth_report import depth_rows
from flowrect.evaluation.predictions import Origin, Prediction, file_name, write
from flowrect.evaluation.scores import TRUTH
from flowrect.evaluation.stamp import of_method
from flowrect.methods import PoseEstimate
from flowrect.metrics import METRIC_WH
from flowrect.resize import Sizing, sized
from simgen.errors import UserError


def test_the_truth_beats_a_wrong_pose_and_the_length_of_t_does_not_matter():
    R, t = turned(0.3, -0.4, 0.5), along_x()
    pair = plane_pair(R, t, np.array([0.002, 0.02, 0.04]))
    window = sized(pair, Sizing(METRIC_WH)).metric
    true, wrong = R[0].numpy(), (turned(y=0.4) @ R)[0].numpy()
    rows = []
    for rotation, scale in ((true, 1.0), (true, 7.0), (wrong, 1.0)):
        rect, frame = rectified_by(rotation, scale * t[0].numpy(), window)
        sgbm = load_stereo("sgbm", largest_px=frame.largest_disparity(6))
        found = matched(window, rect, frame, sgbm)
        [row] = found.samples(comparable(window)).by_range((0, 300))
        rows.append(row)
    assert rows[0].coverage > 0.8
    assert rows[1] == pytest.approx(rows[0])
    assert rows[2].median_m > 3 * rows[0].median_m


def ranges_of(path: Path) -> dict[str, list[dict[str, str]]]:
    """Rows of a table, by method."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: [r for r in rows if r["method"] == name] for name in {r["method"] for r in rows}}


@pytest.fixture
def given(tmp_path: Path) -> list[str]:
    """A set, and results on it: of the true pose, of two wild ones, of a method that failed, and of
    one that was interrupted after a pair."""
    data = road_set(tmp_path / "set", frames=1)
    pairs = Delivery(data, "all", (96, 48)).open()
    away = Rotation.from_rotvec([0, 150, 0], degrees=True).as_matrix()
    for method in ("right", "wild", "away", "failing", "begun"):
        rows = []
        for i in range(1 if method == "begun" else len(pairs)):
            T = pairs[i].input.T_right_left
            t = {"wild": np.array([0.0, -1.0, 0.0]), "failing": None}.get(method, T[:3, 3])
            R = away if method == "away" else T[:3, :3]
            pose = None if t is None else PoseEstimate(R, t)
            rows.append(Prediction(i, "", pose, "" if pose else "too few matches"))
        origin = Origin(method, "nominal", pairs.fingerprint, of_method(method))
        write(tmp_path / "results" / "predictions" / f"{method}.h5", rows, origin)
    return ["--data", str(data), "--results", str(tmp_path / "results"), "--size", "96x48",
            "--split", "all"]  # fmt: skip


def test_every_method_answers_for_the_same_pixels_and_failures_are_scored_with_the_prior(
    given, tmp_path, monkeypatch, capsys
):
    monkeypatch.delenv("FLOWRECT_STEREO_ONNX", raising=False)
    assert main([*given, "--stereo", "sgbm", "onnx"]) == 0
    printed = capsys.readouterr().out
    absent = r"onnx stereo matcher \(DLNR and others\): no weights, no file is named.*High-freq"
    assert re.search(absent + r"uency-Stereo.*licence.*RAFT-Stereo \(MIT\).*sgbm needs no", printed)
    assert "failing (3 failed)" in printed
    assert "wild (3 failed)" in printed  # its baseline is vertical
    assert "away (3 failed)" in printed  # its images have nothing in common
    assert "begun (1 of 3 pairs)" in printed
    of = ranges_of(tmp_path / "results" / "depth.sgbm.nominal.csv")
    begun = of.pop("begun")
    assert {(r["pairs"], r["failed_pairs"]) for r in begun} == {("1", "0")}
    for figure in ("pixels", "coverage", "mae_m", "common_mae_m", "all_mae_m", "all_truth_mae_m"):
        column = {name: [r[figure] for r in found] for name, found in of.items()}
        assert column["failing"] == column["wild"] == column["away"] == column[PRIOR]
        assert column["right"] == column[TRUTH]
    assert sum(int(r["pixels"]) for r in of[TRUTH]) > 1000
    written = (tmp_path / "results" / "depth.sgbm.nominal.md").read_text(encoding="utf-8")
    rows = [line for line in written.splitlines() if line.startswith("| failing (3 failed) | ")]
    assert len(rows) == 1
    assert "\nLeft out: onnx stereo matcher (DLNR and others): no weights, " in written
    mae = float(of["failing"][0]["common_mae_m"])
    assert rows[0].split(" | ")[1].startswith(f"{mae:.2f} / ")
    page = (tmp_path / "results" / "report.html").read_text(encoding="utf-8")
    shown = 3 * len(of) + 1  # three pairs, one of them also by the method that has begun
    assert page.count("data:image/jpeg") == 2 * shown  # an overlay and depth
    assert page.count("<svg") == 2
    assert "failing (3 failed)" in page


def test_an_interrupted_run_looks_at_no_pair_again(given, tmp_path, capsys, monkeypatch):
    looked: list[int] = []
    limit = 5

    def flat(left, right):
        if len(looked) == limit:
            raise KeyboardInterrupt
        looked.append(1)
        return np.full(left.shape[:2], 1.0 + len(looked), np.float32)

    monkeypatch.setitem(STEREO, "flat", lambda *_: flat)
    monkeypatch.setattr("flowrect.evaluate_depth.track", lambda given, _: given)
    assert main([*given, "--stereo", "flat"]) == 130
    assert "the same command goes on" in capsys.readouterr().out
    limit = 100
    assert main([*given, "--stereo", "flat"]) == 0
    times = len(looked)
    files = list((tmp_path / "results" / "disparity" / "flat").iterdir())
    assert times == len(files)  # each image pair once, in both runs together
    files[0].write_bytes(b"cut off")
    assert main([*given, "--stereo", "flat"]) == 0
    assert len(looked) == times + 1
    files[0].unlink()
    monkeypatch.setattr("flowrect.evaluation.stamp.of_stereo", lambda *_: "other weights")
    assert main([*given, "--stereo", "flat"]) == 0
    assert len(looked) == 2 * times + 1


def test_disparities_are_stamped_with_the_package_that_runs_the_network(tmp_path, monkeypatch):
    path = tmp_path / "exported.onnx"
    path.write_bytes(b"of some network")
    before = stamp.of_stereo("sgbm"), stamp.of_stereo("onnx", str(path))
    known = stamp._version
    monkeypatch.setattr(stamp, "_versions", stamp._versions.__wrapped__)
    monkeypatch.setattr(stamp, "_version", lambda n: "9" if n == "onnxruntime" else known(n))
    assert stamp.of_stereo("sgbm") == before[0]
    again = stamp.of_stereo("onnx", str(path))
    assert again != before[1]
    path.with_name(f"{path.name}.data").write_bytes(b"weights that the graph refers to")
    assert stamp.of_stereo("onnx", str(path)) != again


def test_commands_share_one_page_and_each_replaces_its_own_part(tmp_path):
    sources = one_page.Sources("pairs", {"a": "1"})
    one_page.put(tmp_path, "depth.sgbm.gt", ["<p>depth</p>"], sources)
    one_page.put(tmp_path, one_page.FIRST, ["<p>old</p>"], sources)
    joined = one_page.Sources("pairs", {"a": "1", "b": "1"})
    page = one_page.put(tmp_path, one_page.FIRST, ["<p>a</p>", "<p>b</p>"], joined)
    text = page.read_text("utf-8")
    assert 0 < text.index("<p>a</p><p>b</p>") < text.index("<p>depth</p>")
    assert "old" not in text
    assert text.count("<html") == 1


@pytest.mark.parametrize("later", [("others", {"a": "1"}), ("pairs", {"a": "2"})])
def test_what_is_of_other_pairs_or_weights_leaves_the_page(later, tmp_path):
    one_page.put(tmp_path, "depth", ["<p>depth</p>"], one_page.Sources("pairs", {"a": "1"}))
    page = one_page.put(tmp_path, one_page.FIRST, ["<p>a</p>"], one_page.Sources(*later))
    assert "depth" not in page.read_text("utf-8")
    assert [p.name for p in (tmp_path / "sections").iterdir()] == ["rectification.html"]


def tally(samples: dict[int, DepthSamples], failed: int = 0) -> Tally:
    return Tally(samples, {i: f"scene {i}" for i in samples}, failed=failed)


def test_the_mean_error_has_an_interval_over_scenes_and_so_has_what_it_exceeds_the_truth_by():
    """Against draws in a loop, of two pairs a scene."""
    rng = np.random.default_rng(3)
    true = [rng.choice([5.0, 15.0], 40) for _ in range(24)]
    noise = [rng.normal(size=40) * rng.uniform(0.2, 2) for _ in true]
    rows = {"wrong": [a + 2 * b + 0.1 for a, b in zip(true, noise, strict=True)],
            TRUTH: [a + b for a, b in zip(true, noise, strict=True)]}  # fmt: skip
    rows["wrong"][0][:5] = np.nan
    tallies = {
        name: Tally({i: DepthSamples(a, b) for i, (a, b) in enumerate(zip(true, row, strict=True))},
                    {i: f"scene {i // 2}" for i in range(len(row))})
        for name, row in rows.items()
    }  # fmt: skip

    def mean(row: str, pairs: list[int]) -> float:
        by_range = {5.0: [], 15.0: []}
        for i in pairs:
            for k, z in enumerate(true[i]):
                if not np.isnan(rows["wrong"][i][k]):
                    by_range[z].append(abs(rows[row][i][k] - z))
        return float(np.mean([np.mean(errors) for errors in by_range.values()]))

    draws = []
    for _ in range(1500):
        pairs = [2 * s + k for s in rng.integers(0, 12, 12) for k in (0, 1)]
        draws.append((mean("wrong", pairs), mean("wrong", pairs) - mean(TRUTH, pairs)))
    found = comparisons(tallies)["wrong"].mean
    assert found.mae_m == pytest.approx(mean("wrong", list(range(24))))
    assert found.truth_mae_m == pytest.approx(mean(TRUTH, list(range(24))))
    low, high = np.quantile(draws, [0.025, 0.975], axis=0)
    assert found.interval_m == pytest.approx((low[0], high[0]), rel=0.06)
    assert found.excess_interval_m == pytest.approx((low[1], high[1]), rel=0.06)
    assert comparisons(tallies)[TRUTH].mean.excess_interval_m == (0, 0)
    counts = {m: t.counts for m, t in tallies.items()}
    cells = {row[0]: row for row in depth_rows(comparisons(tallies), counts)}["wrong"]
    own, by_truth, more = cells[-1].split("\n")
    assert own == f"{found.mae_m:.2f} [{found.interval_m[0]:.2f}, {found.interval_m[1]:.2f}]"
    assert by_truth == f"truth {found.truth_mae_m:.2f}"
    assert more.startswith(f"+{found.mae_m - found.truth_mae_m:.2f} [+")


def test_pairs_that_were_not_predicted_are_in_no_figure_and_cost_the_others_none():
    true = np.array([5.0, 6.0, 50.0])
    some = np.array([np.nan, 7.0, 53.0])
    tallies = {
        "all": tally({0: DepthSamples(true, true + 1), 1: DepthSamples(true, some)}, failed=1),
        "begun": tally({1: DepthSamples(true, true)}),
        "not yet": Tally(),
        TRUTH: tally({i: DepthSamples(true, np.array([np.nan, 6.0, np.inf])) for i in (0, 1)}),
    }
    near = {name: found.ranges[0] for name, found in comparisons(tallies).items()}
    own, common, _ = near["all"]
    assert (own.pixels, own.answered, own.mae_m) == (4, 3, 1.0)
    assert (common.pixels, common.mae_m) == (2, 1.0)
    own, common, _ = near["begun"]
    assert (own.pixels, common.pixels, common.mae_m) == (2, 1, 0.0)
    assert (
        comparisons(tallies)["all"].ranges[3].common.pixels == 2
    )  # at 50 m, infinity is an answer
    alone = {name: tallies[name] for name in ("begun", TRUTH)}
    assert comparisons(alone)["begun"].ranges[0] == near["begun"]  # whoever else is there
    assert near["not yet"].own.pixels == 0
    names = [row[0] for row in depth_rows(comparisons(tallies), {m: t.counts for m, t in
                                                                 tallies.items()})]  # fmt: skip
    assert names == ["all (1 failed)", "begun (1 of 2 pairs)", "not yet (0 of 2 pairs)", TRUTH]


def test_a_row_that_leaves_out_hard_pixels_is_held_against_the_truth_of_its_own():
    true = np.array([5.0, 5.0, 15.0])
    tallies = {
        "easy": tally({0: DepthSamples(true, np.array([6.0, np.nan, 15.0]))}),
        "near": tally({0: DepthSamples(true, np.array([6.0, 6.0, np.nan]))}),
        TRUTH: tally({0: DepthSamples(true, np.array([5.5, 9.0, 15.0]))}),
    }
    found = comparisons(tallies)
    own, common, by_truth = found["easy"].ranges[0]
    assert (own.coverage, common.mae_m, by_truth.mae_m) == (0.5, 1.0, 0.5)
    near = found[TRUTH].ranges[0]
    assert near.common.mae_m == near.by_truth.mae_m == 2.25
    rows = {row[0]: row[1:] for row in depth_rows(found, {m: t.counts for m, t in tallies.items()})}
    assert rows["easy"][0] == "1.00 / 1.00\ntruth 0.50 / 0.50\n50%"
    assert rows["easy"][-1] == "0.50\ntruth 0.25\n+0.25"
    assert rows["near"][1] == "–\n0%"
    assert rows["near"][-1] == "–"  # not the 1 m of what it answers
    assert rows[TRUTH][0] == "2.25 / 2.25\n100%"
    assert rows[TRUTH][2] == "–"  # nothing is so far away


def test_each_stereo_matcher_and_t_has_its_files_and_one_without_weights_a_line(
    given, tmp_path, capsys, monkeypatch
):
    monkeypatch.delenv("FLOWRECT_HITNET", raising=False)
    monkeypatch.setattr(hitnet_weights, "SHIPPED", tmp_path)
    for name in ("far", "near"):
        flat = partial(np.full, METRIC_WH[::-1], 1.0 if name == "far" else 9.0)
        monkeypatch.setitem(STEREO, name, lambda *_, flat=flat: lambda *_: flat(dtype=np.float32))
    given += ["--pairs", "1"]
    assert main([*given, "--stereo", "far", "near=a/b.pt", "hitnet"]) == 0
    assert "hitnet: no weights are shipped. Train" in capsys.readouterr().out
    folder = tmp_path / "results"
    names = {path.name for path in folder.glob("depth.*.csv")}
    assert names == {"depth.far.nominal.csv", f"depth.{file_name('near=a/b.pt')}.nominal.csv"}
    for name in names:
        part = (folder / "sections" / name).with_suffix(".html").read_text("utf-8")
        assert "hitnet: no weights are shipped" in part
        assert part in (folder / "report.html").read_text("utf-8")
    assert main([*given, "--stereo", "hitnet"]) == 2
    assert main([*given, "--stereo", "far", "hitnet=typo.safetensors"]) == 2
    assert "hitnet: typo.safetensors: no such file" in capsys.readouterr().err


def test_negative_disparities_of_a_wrong_pose_are_answers_and_of_the_true_one_refused(
    given, tmp_path, monkeypatch, capsys
):
    """The unrectified pair is looked at first, then the truly rectified one, once."""
    given += ["--pairs", "1", "--stereo"]

    def answers(*disparities: float) -> StereoMatcher:
        rest = iter(disparities)
        return lambda *_: np.full(METRIC_WH[::-1], next(rest), np.float32)

    wrong, turned = answers(-3.0, 3.0), answers(3.0, -3.0)
    monkeypatch.setitem(STEREO, "wrong", lambda *_: wrong)
    monkeypatch.setitem(STEREO, "turned", lambda *_: turned)
    assert main([*given, "wrong"]) == 0
    assert main([*given, "turned"]) == 2
    assert re.search(r"turned: .* true pose, and most .* negative \(median -3.0 px\)",
                     capsys.readouterr().err)  # fmt: skip


def test_a_matcher_that_stops_costs_the_others_nothing(given, tmp_path, monkeypatch, capsys):
    def stops(*_: object) -> np.ndarray:
        raise UserError("stops: images too small")

    flat = partial(np.full, METRIC_WH[::-1], 9.0, dtype=np.float32)
    monkeypatch.setitem(STEREO, "stops", lambda *_: stops)
    monkeypatch.setitem(STEREO, "flat", lambda *_: lambda *_: flat())
    assert main([*given, "--pairs", "1", "--stereo", "stops", "flat"]) == 2
    assert capsys.readouterr().err == "error: stops: images too small\n"
    assert (tmp_path / "results" / "depth.flat.nominal.csv").exists()


def test_depth_without_predictions_or_matcher_is_refused(given, tmp_path, capsys):
    assert main(["--data", str(tmp_path / "no")]) == 2
    assert "no such folder" in capsys.readouterr().err
    assert main([*given, "--size", "64x32"]) == 2
    assert "Run python -m flowrect.evaluate with the same" in capsys.readouterr().err
    assert main([*given, "--stereo", "psm"]) == 2
    assert "stereo matcher 'psm': expected one of sgbm" in capsys.readouterr().err
    assert main([*given, "--stereo"]) == 2
    assert "--stereo: expected some of sgbm" in capsys.readouterr().err
    for option, value, said in (("--pairs", "0", "expected at least 1"),
                                ("--limit", "-1", "expected at least 0"),
                                ("--nearest-m", "0", "expected more than 0")):  # fmt: skip
        assert main([*given, option, value]) == 2
        assert f"{option} {value}: {said}" in capsys.readouterr().err
