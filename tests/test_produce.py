"""A frame follows from its number alone: same bits alone, in a set, in any order, anywhere."""

from __future__ import annotations

import multiprocessing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from simgen import engine, export, halos, report, sensor, show, spray, world
from simgen.checks import check_frame
from simgen.config import Job, RenderOptions, resolve
from simgen.errors import UserError
from simgen.metering import Exposure
from simgen.produce import (
    draw_spec,
    make_frame,
    noise_stream,
    plan_frame,
    render_frame_file,
    scene_of,
    start,
)
from simgen.recipe import SceneSpec
from simgen.run import FrameTask, SetFolder
from simgen.shards import Manifest, ShardSet
from simgen.store import Source, assemble, content_sha256, stored_content, write_frame

OPTIONS = RenderOptions(n=3, size="96x54", recipes="rural", daylight="noon", spp=1)
LORRY_IN_FOG = replace(OPTIONS, rig="truck", daylight="night", weather="fog")
RAIN_AT_NIGHT = replace(OPTIONS, daylight="night", weather="rain")


def _set_of_one(job: Job, source: Source, path: Path) -> Path:
    """A finished set of one frame."""
    path.mkdir()
    manifest = SetFolder(path).open_manifest(job.content(), 16, len(job.rig.pairs))
    entry = assemble(path / "test-00000.h5", [source], attributes={"schema_version": 1},
                     split="test", compression="gzip")  # fmt: skip
    replace(manifest, shards=[entry]).save(path)
    return path


@pytest.fixture(scope="module")
def job(mitsuba_active: None) -> Job:
    import mitsuba as mi

    return resolve(OPTIONS, mi.variant())


@pytest.fixture(scope="module")
def frames(job: Job) -> dict[int, dict[str, object]]:
    """Frames 1 and 0, rendered in this order."""
    return {i: make_frame(job, i, attempt=0)[0] for i in (1, 0)}


@pytest.fixture(scope="module")
def lorry(job: Job) -> tuple[Job, dict[str, object]]:
    """Four cameras in fog at night, and what they see."""
    foggy = resolve(LORRY_IN_FOG, job.variant)
    return foggy, make_frame(foggy, 0, attempt=0)[0]


def _in_a_worker(jobs: list[Job], folder: Path) -> None:
    """Frame 0 of each job, as a worker of a run makes it."""
    start(engine.choose(jobs[0].variant), 1, jobs[0].wh)
    for k, job in enumerate(jobs):
        render_frame_file(FrameTask(job, 0, 0, folder / f"{k}.h5"))


def _rendered_by_a_worker(jobs: list[Job], folder: Path) -> list[Path]:
    """Frame 0 of each job, the first that a new process renders."""
    child = multiprocessing.get_context("spawn").Process(target=_in_a_worker, args=(jobs, folder))
    child.start()
    child.join()
    assert child.exitcode == 0
    return [folder / f"{k}.h5" for k in range(len(jobs))]


def test_a_worker_renders_the_same_bits_whatever_came_before(job, frames, lorry, tmp_path):
    """Here other frames were: frame 1 before the one by day."""
    here = frames[0], lorry[1]
    assert here[1]["spec"]["samples"]["spp"] == 2 * here[0]["spec"]["samples"]["spp"] == 2
    there = _rendered_by_a_worker([job, lorry[0]], tmp_path)
    assert [stored_content(x) for x in there] == [content_sha256(x) for x in here]


@pytest.mark.slow
def test_a_worker_renders_the_same_rain_after_a_day(job, tmp_path):
    """Here alone."""
    at_night = resolve(RAIN_AT_NIGHT, job.variant)
    in_rain = make_frame(at_night, 0, attempt=0)[0]
    assert in_rain["spec"]["rain"]["lens_drops"]
    assert in_rain["spec"]["samples"]["spp"] == 2
    after_a_day = _rendered_by_a_worker([job, at_night], tmp_path)[1]
    assert stored_content(after_a_day) == content_sha256(in_rain)


def test_another_seed_or_index_is_another_frame(job, frames):
    """Another attempt, too: its spec is (below)."""
    images = [frames[0]["image"], frames[1]["image"]]
    images.append(make_frame(replace(job, seed=1), 0, attempt=0)[0]["image"])
    for i, a in enumerate(images):
        for b in images[i + 1 :]:
            assert not np.array_equal(a, b)


def test_every_frame_passes_the_thorough_check(job, frames):
    pairs = np.array(job.rig.pairs, dtype=np.uint8)
    for frame in frames.values():
        failed = [f for f in check_frame(frame, pairs, thorough=True) if not f.passed]
        assert not failed


def test_a_rig_of_four_cameras_is_rendered_checked_shown_and_reported(lorry, tmp_path):
    job, frame = lorry
    pairs = job.rig.pairs
    findings = check_frame(frame, np.array(pairs, dtype=np.uint8), thorough=True)
    assert not [f for f in findings if not f.passed]
    assert len({f.where for f in findings if f.check == "status_bits"}) == 12

    waiting = tmp_path / "waiting.h5"
    content = write_frame(waiting, frame, pairs=pairs, compression="gzip")
    folder = _set_of_one(job, Source(waiting, 0, content), tmp_path / "set")
    (read,) = ShardSet(folder)
    assert read.pairs == list(pairs)
    centres = read.T_world_cam_nominal[:, :3, 3]
    assert np.linalg.norm(centres[3] - centres[0]) == pytest.approx(2.0)
    assert show.save_picture(read, 5, tmp_path / "frame.png").stat().st_size > 10_000
    page = report.write_report(folder, tmp_path / "report.html").read_text("utf-8")
    assert "truck" in page


def test_images_are_exposed(frames):
    for frame in frames.values():
        assert 40 < frame["image"].mean() < 215
        assert frame["image"].std() > 15


def test_the_spec_names_spray_and_halos_only_where_they_are(frames, lorry):
    by_day = frames[0]["spec"]
    fast = {m["instance"] for m in by_day["movers"] if m["speed_m_s"] >= spray.FROM_M_S}
    assert by_day["spray"]
    assert {p["instance"] for p in by_day["spray"]} <= fast
    assert by_day["halos"] is None
    in_fog = lorry[1]["spec"]
    assert in_fog["spray"] is None
    assert in_fog["halos"]["g"] == halos.FORWARD


def test_frames_of_a_scene_share_the_road_but_not_the_rig(job):
    drive = replace(job, frames_per_scene=2)
    first, second = plan_frame(drive, 2, 0), plan_frame(drive, 3, 0)
    assert first.spec == second.spec
    ahead = second.drive.T_world_vehicle[:3, 3] - first.drive.T_world_vehicle[:3, 3]
    assert 2.0 < np.linalg.norm(ahead) < 4.0
    assert not np.array_equal(first.posed.perturbation_deg, second.posed.perturbation_deg)


def test_a_frame_that_is_drawn_again_stays_in_the_scene_of_the_others(job):
    drive = replace(job, frames_per_scene=2)
    first, second, again = (plan_frame(drive, *x) for x in ((2, 0), (3, 0), (3, 1)))
    assert first.spec == second.spec == again.spec
    np.testing.assert_array_equal(second.drive.T_world_vehicle, again.drive.T_world_vehicle)
    assert not np.array_equal(second.posed.perturbation_deg, again.posed.perturbation_deg)


def test_the_only_frame_of_a_scene_is_drawn_again_with_it(job):
    assert plan_frame(job, 2, 1).spec == draw_spec(job, 2, 1) != draw_spec(job, 2, 0)


def test_frames_share_the_first_draw_whose_road_can_be_built(job, monkeypatch):
    shared, build = replace(job, frames_per_scene=2), world.drive
    unbuildable = [draw_spec(shared, 1, 0)]

    def drive(spec: SceneSpec, *args: object, **kwargs: object) -> world.Drive:
        if spec in unbuildable:
            raise RuntimeError("no road")
        return build(spec, *args, **kwargs)

    monkeypatch.setattr(world, "drive", drive)
    assert {plan_frame(shared, *x).spec.seed for x in ((2, 0), (3, 0), (3, 2))} == {
        draw_spec(shared, 1, 1).seed
    }
    unbuildable += [draw_spec(shared, 1, k) for k in (1, 2)]
    with pytest.raises(RuntimeError, match="no road for scene 1 in 3 draws: RuntimeError: no road"):
        plan_frame(shared, 2, 0)


def test_scene_index_counts_whole_scenes():
    assert [scene_of(i, 4) for i in (0, 3, 4, 11)] == [0, 0, 1, 2]


def test_recipes_are_drawn_by_their_shares(job):
    mixed = resolve(replace(OPTIONS, recipes=""), job.variant)
    names = [draw_spec(mixed, i, 0).recipe for i in range(400)]
    total = sum(r.share for r in mixed.recipes.values())
    for name, recipe in mixed.recipes.items():
        expected = recipe.share / total
        sigma = np.sqrt(expected * (1 - expected) / 400)
        assert abs(names.count(name) / 400 - expected) < 4 * sigma


def test_export_round_trips(job, frames, tmp_path, monkeypatch):
    """What the EXR files hold is what the shard holds, and their radiance develops to its image."""
    waiting = tmp_path / "waiting.h5"
    content = write_frame(waiting, frames[0], pairs=job.rig.pairs, compression="gzip")
    folder = _set_of_one(job, Source(waiting, 0, content), tmp_path / "set")

    monkeypatch.setattr(export.engine, "activate", lambda chosen: None)
    paths = export.export_frame(folder, 0, tmp_path / "out")
    frame = ShardSet(folder)[0]
    frame_plan = plan_frame(job, 0, 0)
    for c in range(3):
        exr = export.read_exr(tmp_path / "out" / f"camera-{c}.exr")
        np.testing.assert_array_equal(exr["depth.Z"], frame.depth[c])
        np.testing.assert_array_equal(exr["id.instance"], frame.instance[c])
        np.testing.assert_array_equal(exr["id.semantic"], frame.semantic[c])
        radiance = np.stack([exr[k] for k in "RGB"], axis=-1)
        exposure = Exposure(**frame.spec["exposure"][c])
        noise = noise_stream(frame_plan, job, c)
        np.testing.assert_array_equal(sensor.develop(radiance, exposure, rng=noise), frame.image[c])
    pair = export.read_exr(tmp_path / "out" / "pair-0-2.exr")
    np.testing.assert_array_equal(np.stack([pair["flow.u"], pair["flow.v"]], -1), frame.flow(2))
    np.testing.assert_array_equal(pair["status.reverse"], frame.flow_status_reverse[2])
    assert all(path.exists() for path in paths)

    # A set that today's program would draw otherwise is not given another scene's radiance.
    manifest = Manifest.load(folder)
    replace(manifest, config={**manifest.config, "seed": job.seed + 1}).save(folder)
    with pytest.raises(UserError, match="is drawn otherwise by this one"):
        export.export_frame(folder, 0, tmp_path / "again")
    assert not (tmp_path / "again").exists()
