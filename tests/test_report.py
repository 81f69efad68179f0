"""The page and the words about a set: complete, true to the set, and in need of nothing else."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from matplotlib.patches import StepPatch
from small_set import HEIGHT_M, HW, make_frame, write_set

from simgen import survey
from simgen.describe import _summary, _versions, describe
from simgen.errors import UserError
from simgen.report import _angles, _contact_sheet, _cost, write_report
from simgen.run import LOG, SetFolder
from simgen.schema import FIELDS, LABELS, VISIBLE
from simgen.shards import MANIFEST, Manifest, ShardSet
from simgen.validate import validate_folder

FAILURE = {"frame_index": 4, "attempt": 2, "reasons": ["depth < 1 m", "no <b>sky</b>"], "seed": 0}


class Page(HTMLParser):
    """Tags with their attributes, and whether every tag is closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in ("img", "meta", "br"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    frames = [make_frame(i) for i in range(4)]
    return write_set(tmp_path_factory.mktemp("set"), frames, failures=[FAILURE])


@pytest.fixture(scope="module")
def text(folder: Path) -> str:
    return write_report(folder, folder / "report.html").read_text(encoding="utf-8")


# --- measuring -----------------------------------------------------------------------------------


@pytest.mark.parametrize("hw", [HW, (270, 480)])
def test_measured_shares_are_those_of_all_pixels(tmp_path: Path, hw: tuple[int, int]) -> None:
    drawn = make_frame(1, hw=hw)
    m = survey.measure(ShardSet(write_set(tmp_path, [drawn])).frame(1))
    visible = (drawn["flow_status"] & VISIBLE) > 0
    np.testing.assert_allclose(m.overlap, visible.mean(axis=(1, 2)), atol=0.01)
    np.testing.assert_allclose(m.brightness, drawn["image"].mean(axis=(1, 2, 3)) / 255, atol=0.01)
    road = m.label_counts[LABELS["road"]] / m.label_counts.sum()
    assert road == pytest.approx((drawn["depth"] > 0).mean(), abs=0.01)
    assert m.depth_counts.sum() == m.label_counts[LABELS["road"]]
    assert m.depth_range_m[0] == pytest.approx(HEIGHT_M * 16 / 9, rel=0.05)


def test_content_counts_classes_instances_and_what_is_far(tmp_path: Path) -> None:
    drawn = make_frame(1, hw=(270, 480))
    m = survey.measure(ShardSet(write_set(tmp_path, [drawn])).frame(1))
    assert (m.num_classes, m.num_instances) == (2, 1)
    for share, far in zip(m.far_shares, survey.FAR_M, strict=True):
        assert share == pytest.approx((drawn["depth"] > far).mean(), abs=0.01)


def test_flow_is_measured_also_where_it_is_not_stored(tmp_path: Path) -> None:
    drawn = [make_frame(1)]
    stored, derived = (
        survey.measure(ShardSet(write_set(tmp_path / str(flow), drawn, flow=flow)).frame(1))
        for flow in (True, False)
    )
    np.testing.assert_array_equal(stored.flow_counts, derived.flow_counts)
    assert stored.flow_counts.sum() == 3 * HW[0] * HW[1]


def test_the_log_keeps_the_last_record_of_a_frame_and_counts_broken_lines(folder: Path) -> None:
    line = (folder / LOG).read_text().splitlines()[0]
    again = line.replace('"time": 0.0', '"time": 99.0').replace('"path": 2.0', '"path": 7.0')
    (folder / "copy").mkdir()
    foreign = '{"worker_died": "x"}\n{"index": 0, "seconds": {}}\n'  # no record, none of ours
    (folder / "copy" / LOG).write_text(f"{line}\n{again}\n{line[:20]}\n{foreign}")
    log = survey.read_log(folder / "copy")
    assert log.stage_seconds()["path"].tolist() == [7.0]
    assert log.num_unreadable == 2


# --- the page ------------------------------------------------------------------------------------


def test_the_page_needs_no_other_file(text: str) -> None:
    tags = Page(text).tags
    assert not {tag for tag, _ in tags} & {"link", "script", "iframe", "object"}
    places = [a[k] for _, a in tags for k in ("src", "href", "xlink:href") if k in a]
    assert places
    assert all(place and re.match(r"data:image/|#", place) for place in places)
    assert "url(http" not in text
    assert "@import" not in text


def test_the_page_is_well_formed(text: str) -> None:
    page = Page(text)
    assert page.open == []
    assert sum(tag == "svg" for tag, _ in page.tags) == 8


def test_charts_refer_to_parts_of_their_own(text: str) -> None:
    for svg in re.findall(r"<svg.*?</svg>", text, re.DOTALL):
        references = set(re.findall(r'(?:url\(|href=")#([^")]+)', svg))
        assert references <= set(re.findall(r'id="([^"]+)"', svg))


def test_the_page_tells_files_and_failures(folder: Path, text: str) -> None:
    for shard in Manifest.load(folder).shards:
        assert shard.sha256 in text
    assert "depth &lt; 1 m; no &lt;b&gt;sky&lt;/b&gt;" in text
    assert "1 frames failed, 0 draws were replaced" in text
    assert "4 rig frames (3 train, 1 test), 12 stereo pairs, 96x54 pixels" in text


def test_the_page_tells_the_content_of_each_recipe(text: str) -> None:
    content = re.sub(r"<[^>]+>", " ", text.split("<h2>Content</h2>")[1].split("</section>")[0])
    for name, frames in (("rural", 2), ("urban", 2), ("all", 4)):
        assert re.search(rf"{name} +{frames} +2\.0 +1\.0 ", content)


def test_the_same_set_gives_the_same_page(folder: Path, text: str) -> None:
    again = write_report(folder, folder / "again.html").read_text(encoding="utf-8")
    assert again == text


def test_a_large_set_has_a_sample_of_its_frames_on_the_sheet(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = ShardSet(folder)
    monkeypatch.setattr("simgen.report.MAX_THUMBNAILS", 3)
    sheet = _contact_sheet(frames, [survey.measure(frame) for frame in frames])
    assert re.findall(r'alt="frame (\d)"', sheet) == ["0", "1", "3"]
    assert "Camera 1 of 3 of 4 frames." in sheet


@pytest.mark.parametrize("limit_deg", [0.0, 1.0])
def test_drawn_angles_are_all_counted(folder: Path, limit_deg: float) -> None:
    """Also those of a rig without a perturbation, where all are 0 and none is expected."""
    drawn = [
        replace(survey.measure(f), perturbation_deg=np.zeros((3, 3))) for f in ShardSet(folder)
    ]
    (axes,) = _angles(drawn, limit_deg).axes
    outlines = [patch.get_data().values for patch in axes.patches if isinstance(patch, StepPatch)]
    assert [values.sum() for values in outlines] == pytest.approx([1.0, 1.0, 1.0])
    assert ("uniform" in [text.get_text() for text in axes.get_legend().texts]) == (limit_deg > 0)


def test_a_set_without_its_log_says_so(tmp_path: Path) -> None:
    assert "The set has no render.jsonl" in _cost(survey.read_log(tmp_path))


def test_a_set_without_frames_is_refused(tmp_path: Path) -> None:
    write_set(tmp_path, [])
    with pytest.raises(UserError, match=r'no finished shard yet.*"simgen render"'):
        write_report(tmp_path, tmp_path / "page.html")


def test_a_place_that_cannot_be_written_is_refused(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"page\.html: cannot write the page .*--out"):
        write_report(folder, tmp_path / "file" / "page.html")


# --- words ---------------------------------------------------------------------------------------


def test_every_field_is_described_with_its_shape(folder: Path) -> None:
    text = describe(folder)
    for name, field in FIELDS.items():
        assert re.search(rf"^  {name} +n[\d,]* +{field.dtype} +{re.escape(field.meaning)}$", text,
                         re.MULTILINE), name  # fmt: skip
    assert re.search(r"^  flow +n,3,54,96,2 ", text, re.MULTILINE)


def test_the_description_counts_frames_by_split_and_stratum(folder: Path) -> None:
    text = describe(folder)
    assert "train: 3 rig frames, 9 pairs" in text
    assert "test: 1 rig frames, 3 pairs" in text
    assert re.search(r"rural +noon +partly_cloudy +2$", text, re.MULTILINE)
    assert "frame 4, attempt 2, failed: depth < 1 m; no <b>sky</b>" in text


def test_the_reading_example_runs(folder: Path) -> None:
    example = describe(folder).split("Reading it\n")[1]
    names: dict[str, object] = {}
    exec("\n".join(line.removeprefix("  ") for line in example.splitlines()), names)
    assert np.shape(names["image"]) == (*HW, 3)
    assert np.shape(names["flow"]) == (*HW, 2)


def test_the_example_of_the_readme_reads_what_it_says(folder: Path, capsys) -> None:
    readme = (Path(__file__).parents[1] / "README.md").read_text("utf-8")
    example = readme.split("```python\n")[1].split("```")[0]
    for of_the_readme, here in {'"shards"': repr(str(folder)), "1440": "54", "2560": "96"}.items():
        assert of_the_readme in example
        example = example.replace(of_the_readme, here)
    names: dict[str, object] = {}
    exec(example, names)
    assert capsys.readouterr().out == "rural noon\n"
    stated = re.findall(r"^ *((?:flow = )?frame.+?)  +# (\(.+\))  *(\w+)", example, re.MULTILINE)
    assert len(stated) == 5
    for code, shapes, what in stated:
        values = eval(f"[{code.rpartition(' = ')[2]}]", {**names, "pair": 0})
        assert ", ".join(str(x.shape) for x in values) == shapes
        assert str(values[0].dtype) == (what if what != "drawn" else "float64")


@pytest.mark.parametrize("asked, said", [
    ({}, "asked for: 12 pairs, seed 0"),
    ({"train": 12, "test": 12}, "asked for: 12 pairs, seed 0"),
    ({"train": 12, "test": 9}, "asked for: --n 12 --split train, --n 9 --split test, seed 0"),
    ({"test": 12}, "asked for: --n 12 --split test, seed 0"),
])  # fmt: skip
def test_what_was_asked_of_each_side_is_described(folder: Path, asked, said) -> None:
    assert said in _summary(folder, replace(Manifest.load(folder), pairs_asked=asked))


def test_versions_that_differ_are_counted() -> None:
    specs = [{"versions": {"numpy": v, "mitsuba": "3.9.1"}} for v in ("2.1", "2.0", "2.1")]
    assert _versions(specs) == (
        "Made with\n  mitsuba  3.9.1\n  numpy    2.0 (1 frames), 2.1 (2 frames)"
    )


def test_the_rule_for_samples_is_told(folder: Path, text: str) -> None:
    assert "<td>2, 4 where lamps burn</td>" in text
    assert re.search(r"^  samples\.night_spp +4$", describe(folder), re.MULTILINE)


def test_a_set_of_an_older_version_is_read_told_and_checked_but_not_continued(
    folder: Path, tmp_path: Path
) -> None:
    """Its manifest states neither a rule for samples nor versions."""
    old = shutil.copytree(folder, tmp_path / "old")
    manifest = json.loads((old / MANIFEST).read_text("utf-8"))
    asked = manifest["config"].copy()
    del manifest["config"]["samples"], manifest["versions"]
    (old / MANIFEST).write_text(json.dumps(manifest), "utf-8")
    assert [int(frame.frame_index) for frame in ShardSet(old)] == [0, 1, 2, 3]
    assert re.search(r"^  spp +2$", described := describe(old), re.MULTILINE)
    assert "samples." not in described
    page = write_report(old, old / "report.html").read_text("utf-8")
    assert "<td>2 by day; where lamps burn as each frame&#x27;s spec says</td>" in page
    assert not [f for f in validate_folder(old).failed if f.check == "settings"]
    with pytest.raises(UserError, match="; samples: not in the folder; versions: not in"):
        SetFolder(old).open_manifest(asked, 16, 12)


def test_a_set_without_frames_is_described_as_such(tmp_path: Path) -> None:
    text = describe(write_set(tmp_path, []))
    assert "no finished shard yet" in text
    assert "Reading it" not in text


def test_a_folder_without_a_set_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"no manifest\.json here"):
        describe(tmp_path)
