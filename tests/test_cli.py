from __future__ import annotations

import dataclasses
import errno
import os
import re
import subprocess
import sys
from pathlib import Path

import fakes
import pytest
from test_config import _presets_file, _recipe_file

from simgen import __main__ as cli
from simgen import doctor, rendering, run
from simgen.config import RenderOptions, resolve
from simgen.errors import UserError
from simgen.shards import ShardSet

SMALL = ["--size", "96x54", "--variant", "scalar_rgb"]
ALONE = ["--workers", "1", *SMALL]


@pytest.fixture
def fake_renderer(monkeypatch):
    """``fake_renderer(fakes.render)``: renders 8×6 pixels instead of roads."""

    def use(render_one: run.RenderOne) -> None:
        monkeypatch.setattr(rendering, "_render_one", lambda: render_one)
        monkeypatch.setattr(rendering, "_start_worker", lambda: fakes.start)

    return use


def _paragraph(capsys: pytest.CaptureFixture[str]) -> str:
    """What was printed, which must be one paragraph on stderr."""
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("simgen: ")
    assert err.count("\n") == 1
    assert "Traceback" not in err
    return err


# --- rendering -----------------------------------------------------------------------------------


def test_render_says_what_it_will_do_does_it_and_says_what_came_of_it(
    tmp_path, capsys, fake_renderer
):
    fake_renderer(fakes.render)
    out = tmp_path / "set"
    args = ["render", "--n", "4", "--workers", "1", "--out", str(out), *SMALL]
    assert cli.main(args) == 0
    said = capsys.readouterr().err
    assert "--n 4 is rounded up to 6 pairs: a rig frame has 3." in said
    assert "2 rig frames, 6 pairs, 96x54, seed 0, scalar_rgb: about 1 min and " in said
    assert "frame 1: 2 of 2, 6 pairs, " in said
    assert f"2 rig frames in 2 shards: {out}\n" in said
    assert [int(f.frame_index) for f in ShardSet(out)] == [0, 1]
    assert cli.main(args) == 0
    assert "Going on: 2 of 2 rig frames are there already." in capsys.readouterr().err


def test_the_hours_told_beforehand_count_the_samples_of_nights(tmp_path):
    """Half of the share of a preset whose sun sets in its middle."""

    def seconds(daylight: str, spp: int) -> float:
        job = resolve(RenderOptions(n=3, daylight=daylight, spp=spp), "llvm_ad_rgb")
        return rendering._estimate(job, tmp_path, workers=1).seconds_per_frame

    path = _presets_file(tmp_path, "daylight", even="dusk: sun_elevation_deg = [-3.0, 3.0]")
    assert seconds("night", 2) == seconds("noon", 4) > seconds("noon", 2)
    assert seconds(str(path), 2) == pytest.approx((seconds("noon", 2) + seconds("night", 2)) / 2)


def test_as_many_workers_as_fit_render_if_nobody_says_how_many(
    tmp_path, capsys, fake_renderer, monkeypatch
):
    fake_renderer(fakes.render)
    asked = []
    monkeypatch.setattr(rendering, "num_workers", lambda *of: asked.append(of) or 2)
    assert cli.main(["render", "--n", "9", "--out", str(tmp_path), *SMALL]) == 0
    assert asked == [((96, 54), 3, 3)]  # size, cameras, frames that are left
    assert ", by 2 workers\n" in capsys.readouterr().err


def test_failed_frames_are_listed_and_the_status_is_1(tmp_path, capsys, fake_renderer):
    fake_renderer(fakes.reject_always)
    assert cli.main(["render", "--n", "6", "--out", str(tmp_path / "set"), *ALONE]) == 1
    said = capsys.readouterr().err
    assert "Frame 1 is drawn again: attempt 0 is bad\n" in said
    assert "Frame 1 failed: attempt 2 is bad\n" in said
    assert said.endswith("simgen: 1 frames could not be made\n")


def test_brackets_in_a_reason_are_printed_as_they_are(tmp_path, capsys, fake_renderer):
    fake_renderer(fakes.reject_first_attempt)
    assert cli.main(["render", "--n", "6", "--out", str(tmp_path / "set"), *ALONE]) == 0
    assert "depth 7 (limit 3) [camera 0]; too dark\n" in capsys.readouterr().err


def test_ctrl_c_is_a_sentence_and_status_130(tmp_path, capsys, monkeypatch):
    def interrupted(options: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(rendering, "render", interrupted)
    assert cli.main(["render", "--n", "9", "--out", str(tmp_path)]) == 130
    said = capsys.readouterr().err
    assert said == "\nsimgen: stopped. Finished frames are kept; the same command goes on.\n"


def test_a_renderer_that_cannot_start_is_an_error_of_one_paragraph(
    tmp_path, capsys, fake_renderer, monkeypatch
):
    fake_renderer(fakes.render)
    monkeypatch.setattr(rendering, "_start_worker", lambda: _fails)
    assert cli.main(["render", "--n", "3", "--out", str(tmp_path / "set"), *SMALL]) == 2
    said = capsys.readouterr().err
    assert said.splitlines()[-1].startswith("simgen: The renderer cannot start (ImportError: no")
    assert "Traceback" not in said


def _fails(*_: object) -> None:
    raise ImportError("no mitsuba")


# --- bad input -----------------------------------------------------------------------------------


@pytest.mark.parametrize("args, expected", [
    (["--n", "0"], "--n 0: expected a whole number from 1 on."),
    (["--n", "-9"], "--n -9: expected a whole number from 1 on."),
    (["--n", "9", "--recipes", "moon"], "Recipe 'moon' is not known. Expected one of highway, "),
    (["--n", "9", "--size", "640"], "--size '640': expected WIDTHxHEIGHT in pixels"),
    (["--n", "9", "--size", "4x4"], "--size 4x4: expected from 96x54 to 16384x16384 pixels."),
    (["--n", "9", "--weather", "hail"], "--weather hail: unknown; expected some of clear, "),
    (["--n", "9", "--daylight", "tea"], "--daylight tea: unknown; expected some of dawn, "),
    (["--n", "9", "--rig", "bike"], "--rig bike: expected one of default, truck, or the path"),
    (["--n", "9", "--variant", "fast"], "--variant fast: expected one of auto, llvm_ad_rgb"),
    (["--n", "9", "--spp", "6"], "--spp 6: expected a power of two up to 4096"),
    (["--n", "9", "--seed", "-1"], "--seed -1: expected a whole number from 0"),
    (["--n", "9", "--frames-per-scene", "0"], "--frames-per-scene 0: expected a whole number"),
])  # fmt: skip
def test_bad_options_are_one_paragraph_and_write_nothing(tmp_path, capsys, args, expected):
    out = tmp_path / "set"
    assert cli.main(["render", "--variant", "scalar_rgb", "--out", str(out), *args]) == 2
    assert expected in _paragraph(capsys)
    assert not out.exists()


@pytest.mark.parametrize("change, expected", [
    ({"keep": "1.5"}, "mine.toml: key 'buildings.keep' = 1.5: Input should be less than or equal"),
    ({"wear": "[0.2, 7]"}, "key 'road.wear' = [0.2, 7]: expected [low, high] with 0 <= low <= "
                           "high <= 1"),
    ({"lanes": '{ "40" = 1.0 }'}, "mine.toml: key 'road.lanes' = {'40': 1.0}: unknown choice '40'; "
                                  "expected some of 1, 2, 3, 4"),
])  # fmt: skip
def test_a_bad_recipe_is_one_paragraph_and_writes_nothing(tmp_path, capsys, change, expected):
    recipe, out = _recipe_file(tmp_path, **change), tmp_path / "set"
    assert (
        cli.main(["render", "--n", "3", "--out", str(out), "--recipes", str(recipe), *SMALL]) == 2
    )
    assert expected in _paragraph(capsys)
    assert not out.exists()


@pytest.mark.parametrize("kind, change, expected", [
    ("daylight", "noon: sun_elevation_deg = [-30.0, -30.0]",
     "[mine]: key 'sun_elevation_deg' = [-30.0, -30.0]: expected [low, high] with -18 <= low <= "
     "high <= 70."),
    ("weather", "fog: visibility_m = [0.0, 0.0]",
     "[mine]: key 'visibility_m' = [0.0, 0.0]: expected [low, high] with 50 <= low <= high <= "),
    ("weather", "fog: visibility_m = 0",
     "[mine]: key 'visibility_m' = 0: expected [low, high] with 50 <= low <= high <= 100000."),
])  # fmt: skip
def test_a_bad_preset_is_one_paragraph_and_writes_nothing(tmp_path, capsys, kind, change, expected):
    path, out = _presets_file(tmp_path, kind, mine=change), tmp_path / "set"
    args = ["render", "--n", "3", "--out", str(out), f"--{kind}", str(path), *SMALL]
    assert cli.main(args) == 2
    assert f"my_{kind}.toml {expected}" in _paragraph(capsys)
    assert not out.exists()


def test_a_misspelt_key_is_one_paragraph_with_a_suggestion(tmp_path, capsys):
    recipe = _recipe_file(tmp_path)
    recipe.write_text(recipe.read_text("utf-8").replace("\nwear", "\nwaer"), "utf-8")
    args = ["render", "--n", "3", "--out", str(tmp_path / "set"), "--recipes", str(recipe), *SMALL]
    assert cli.main(args) == 2
    assert "mine.toml: " in (said := _paragraph(capsys))
    assert "unknown key 'road.waer' (did you mean 'wear'?)" in said


def test_a_folder_of_others_is_one_paragraph_and_left_alone(tmp_path, capsys):
    (tmp_path / "holiday.jpg").touch()
    assert cli.main(["render", "--n", "3", "--out", str(tmp_path), *SMALL]) == 2
    assert "holds files that simgen did not write (holiday.jpg) and no manifest.json" in _paragraph(
        capsys
    )
    assert [p.name for p in tmp_path.iterdir()] == ["holiday.jpg"]


def test_a_disk_that_is_too_small_stops_before_anything_is_written(tmp_path, capsys, monkeypatch):
    usage = run.shutil.disk_usage(tmp_path)
    monkeypatch.setattr(run.shutil, "disk_usage", lambda path: usage._replace(free=10_000))
    out = tmp_path / "set"
    assert cli.main(["render", "--n", "9", "--out", str(out), *SMALL]) == 2
    *_, last = capsys.readouterr().err.splitlines()
    assert re.match(rf"simgen: {out}: the set needs about \d+ kB, but only 10 kB are free", last)
    assert not out.exists()


def test_a_disk_that_is_full_at_the_first_write_is_an_error(tmp_path, capsys, monkeypatch):
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    out = tmp_path / "set"
    assert cli.main(["render", "--n", "3", "--out", str(out), *SMALL]) == 2
    *_, last = capsys.readouterr().err.splitlines()
    assert last.startswith(f"simgen: {out}: the disk is full. All finished frames are kept; free")
    assert not [p.name for p in out.iterdir() if p.is_file() and p.name != run.LOCK]


@pytest.mark.parametrize("workers, seconds", [(1, 3600.0), (2, 7200.0)])
def test_a_set_that_goes_on_says_what_is_left(
    tmp_path, capsys, fake_renderer, monkeypatch, workers, seconds
):
    """Frames of the other side are no part of what is asked for, nor is what is done already."""
    fake_renderer(fakes.render)
    args = ["render", "--n", "21", "--out", str(tmp_path), "--workers", str(workers), *SMALL]
    assert cli.main([*args[:2], "6", *args[3:], "--split", "train"]) == 0
    log = tmp_path / run.LOG
    log.write_text(log.read_text().replace('{"fake": 0.001}', f'{{"fake": {seconds}}}'))
    capsys.readouterr()
    needed = []
    monkeypatch.setattr(run, "check_disk", lambda path, size, force: needed.append(size))
    assert cli.main([*args, "--split", "train"]) == 0
    said = capsys.readouterr().err
    assert "6 rig frames, 18 pairs, 96x54, seed 0, scalar_rgb: the 5 frames left take " in said
    assert "about 5.0 h and " in said
    assert (", by 2 workers\n" in said) == (workers == 2)
    assert cli.main([*args, "--split", "train"]) == 0
    assert "scalar_rgb: all there in " in capsys.readouterr().err
    assert needed == [pytest.approx(needed[0]), 0]
    assert needed[0] > 0


def test_a_folder_that_cannot_be_written_is_an_error(tmp_path, capsys):
    (tmp_path / "file").touch()
    assert cli.main(["render", "--n", "3", "--out", str(tmp_path / "file" / "set"), *SMALL]) == 2
    assert "cannot write here (Not a directory)" in capsys.readouterr().err


def test_other_options_in_the_same_folder_are_refused(tmp_path, capsys, fake_renderer):
    fake_renderer(fakes.render)
    args = ["render", "--n", "3", "--out", str(tmp_path / "set"), *SMALL]
    assert cli.main(args) == 0
    assert cli.main([*args, "--seed", "1", "--no-denoise"]) == 2
    *_, last = capsys.readouterr().err.splitlines()
    assert "denoise: the folder has True, you asked for False; seed: the folder has 0, you" in last


@pytest.mark.parametrize("args", [
    ["validate"], ["report"], ["describe"], ["show", "--frame", "0"],
    ["export", "--frame", "0", "--to", "out"],
])  # fmt: skip
def test_commands_on_a_folder_without_a_set_are_one_paragraph(tmp_path, capsys, monkeypatch, args):
    monkeypatch.chdir(tmp_path)
    assert cli.main([args[0], "nowhere", *args[1:]]) == 2
    assert "no manifest" in (said := _paragraph(capsys))
    assert "nowhere" in said
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("args, expected", [
    ([], "subcommand"), (["render"], "--n"), (["render", "--n", "many"], "many"),
    (["rendre", "--n", "3"], "rendre"), (["render", "--n", "3", "--sed", "1"], "--sed"),
    (["render", "--n", "3", "--compression", "lz4"], "lz4"),
    (["render", "--n", "3", "--split", "val"], "val"),
])  # fmt: skip
def test_what_cannot_be_parsed_exits_with_2_and_names_it(capsys, args, expected):
    with pytest.raises(SystemExit) as stop:
        cli.main(args)
    assert stop.value.code == 2
    said = "".join(capsys.readouterr())
    assert expected in said
    assert "Traceback" not in said


def test_only_user_errors_become_paragraphs(monkeypatch, capsys):
    def broken(options: object) -> int:
        raise ZeroDivisionError

    def mendable(options: object) -> int:
        raise UserError("mend it")

    monkeypatch.setitem(cli._COMMANDS, cli.DescribeOptions, broken)
    with pytest.raises(ZeroDivisionError):
        cli.main(["describe", "x"])
    monkeypatch.setitem(cli._COMMANDS, cli.DescribeOptions, mendable)
    assert cli.main(["describe", "x"]) == 2
    assert _paragraph(capsys) == "simgen: mend it\n"


# --- help ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", cli._COMMANDS, ids=lambda o: o.__name__)
def test_help_mentions_every_option_and_what_it_is_for(capsys, options):
    command = options.__name__.removesuffix("Options").lower()
    with pytest.raises(SystemExit) as stop:
        cli.main([command, "--help"])
    assert stop.value.code == 0
    said = capsys.readouterr().out
    assert options.__doc__.splitlines()[0][:30] in said
    for field in dataclasses.fields(options):
        flag = f"--{field.name.replace('_', '-')}"
        expected = "folder of a set" if field.name == "folder" else flag
        assert re.search(rf"{expected}(?![\w-])", said), "a word, not the start of one"


@pytest.mark.parametrize("args", [["--help"], ["doctor"]])
def test_a_reader_that_leaves_early_is_no_error(monkeypatch, args):
    monkeypatch.setattr(doctor, "diagnosis", lambda: "well")
    read_end, write_end = os.pipe()
    os.close(read_end)
    with open(write_end, "w") as nobody:
        monkeypatch.setattr(sys, "stdout", nobody)
        assert cli.main(args) == 141


def test_help_needs_neither_mitsuba_nor_hdf5():
    code = (
        "import sys; from simgen.__main__ import main\n"
        "try: main(['render', '--help'])\n"
        "except SystemExit: pass\n"
        "print({'mitsuba', 'drjit', 'h5py', 'scipy', 'cv2'} & sys.modules.keys())"
    )
    child = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True,
        cwd=Path(cli.__file__).parents[1],
    )  # fmt: skip
    assert child.stdout.endswith("set()\n"), child.stderr
