"""Training: resuming changes nothing, neither does sharing a batch; it learns; it stops cleanly."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from accelerate.state import AcceleratorState
from painted import painted_pair
from safetensors import safe_open
from safetensors.torch import load_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tiny_network import TINY, TINY_PAPER, network, road_set, training

from flowrect import checkpoint, loop, runlog, train
from flowrect.augment import Augmentation, augmented
from flowrect.calibration import Calibration
from flowrect.config import MODELS, TRAINING, LossWeights
from flowrect.formats import opencv
from flowrect.loading import Loading
from flowrect.resize import Sizing
from flowrect.runlog import RunLog, keep_lines_until
from flowrect.sample import Pair, collate
from flowrect.sources import Pairs
from flowrect.weights import load_weights
from simgen.errors import UserError
from simgen.geometry import intrinsics, transform

REPOSITORY = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return road_set(tmp_path_factory.mktemp("set"))


def rows(out: Path) -> list[dict]:
    """Lines of the log, without what a clock says."""
    lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    return [{k: x for k, x in line.items() if k not in ("step_s", "wait_s")} for line in lines]


def losses(out: Path) -> list[float]:
    return [row["loss"] for row in rows(out) if "loss" in row]


def assert_same_tensors(a: Path, b: Path) -> None:
    first, second = load_file(a), load_file(b)
    assert first.keys() == second.keys()
    for name, tensor in first.items():
        assert torch.equal(tensor, second[name]), name


def interrupt_after(steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C arrives during the step after ``steps``."""
    learning_rate = loop.learning_rate

    def interrupting(step: int, *rest: object) -> float:
        if step == steps:
            os.kill(os.getpid(), signal.SIGINT)
        return learning_rate(step, *rest)

    monkeypatch.setattr(loop, "learning_rate", interrupting)


@pytest.mark.parametrize("model, average", [(TINY, 0.6), (TINY_PAPER, 0)], ids=["small", "paper"])
def test_interrupted_and_resumed_equals_uninterrupted_bit_for_bit(
    model, average, data, tmp_path, monkeypatch
):
    whole, parts = (
        training(data, tmp_path / name, model=model, average=average, accumulate=2, max_steps=4,
                 both_directions=False) for name in "ab"
    )  # fmt: skip
    train.train(whole)
    with monkeypatch.context() as patch:
        interrupt_after(2, patch)  # it finishes: 3 steps of 2 batches, amid the second epoch of 4
        train.train(parts)
    assert len(losses(parts.out)) == 3
    train.train(parts)
    assert_same_tensors(whole.out / "last.safetensors", parts.out / "last.safetensors")
    validated_at_the_break = {"step": 3, "validation": rows(parts.out)[3]["validation"]}
    assert [r for r in rows(parts.out) if r != validated_at_the_break] == rows(whole.out)
    a, b = (torch.load(o.out / loop.CHECKPOINT, weights_only=True) for o in (whole, parts))
    assert torch.equal(a["random"]["cpu"], b["random"]["cpu"])
    for x, y in zip(
        a["optimiser"]["state"].values(), b["optimiser"]["state"].values(), strict=True
    ):
        assert torch.equal(x["exp_avg_sq"], y["exp_avg_sq"])


def test_averaged_weights_are_saved_and_training_goes_on_from_its_own(data, tmp_path, monkeypatch):
    """The first step's weights, then .75 of what there was and .25 of each further step's."""
    steps, update = [], loop.Run.update

    def remember(run: loop.Run, lr: float) -> None:
        update(run, lr)
        steps.append({k: x.clone() for k, x in run.task.model.state_dict().items()})

    monkeypatch.setattr(loop.Run, "update", remember)
    plain = training(data, tmp_path / "a", max_steps=3, val_every=1)
    train.train(plain)
    train.train(replace(plain, out=tmp_path / "b", average=0.75))
    expected, averaged = steps[:3], steps[3:]
    saved = load_file(tmp_path / "b" / "last.safetensors")
    for name, tensor in saved.items():
        assert all(torch.equal(a[name], b[name]) for a, b in zip(expected, averaged, strict=True))
        first, second, third = (step[name] for step in expected)
        mean = 0.75 * (0.75 * first + 0.25 * second) + 0.25 * third
        torch.testing.assert_close(tensor, mean, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("average", [-0.1, 1.0])
def test_an_average_that_is_none_is_refused(average, data, tmp_path):
    with pytest.raises(UserError, match=f"--average {average:g}: expected 0 or more, below 1"):
        train.train(training(data, tmp_path, average=average))


def test_a_finished_run_trains_no_further(data, tmp_path):
    options = training(data, tmp_path, max_steps=1)
    scores = train.train(options)
    before = rows(tmp_path)
    assert train.train(options) == scores
    assert rows(tmp_path) == before


def test_tensorboard_has_what_the_file_has(data, tmp_path):
    train.train(training(data, tmp_path, max_steps=10, val_every=5))
    board = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    [step] = [row for row in rows(tmp_path) if row["step"] == 10 and "loss" in row]
    [shown] = board.Scalars("train/loss")
    assert (shown.step, shown.value) == (10, pytest.approx(step["loss"], rel=1e-6))
    scores = [row["validation"]["pitch_deg"] for row in rows(tmp_path) if "validation" in row]
    values = [scalar.value for scalar in board.Scalars("validation/pitch_deg")]
    assert values == pytest.approx(scores, rel=1e-6)
    assert len(values) == 2


def test_loss_falls_on_few_pairs(data, tmp_path):
    options = training(data, tmp_path, overfit=2, max_steps=30, val_every=30, lr=5e-3)
    train.train(options)
    rotation = [row["rotation"] for row in rows(tmp_path) if "loss" in row]
    assert rotation[-1] < 0.5 * rotation[0]


@pytest.mark.slow
def test_two_processes_learn_what_one_does(data, tmp_path):
    """Same global batch. The rotation loss is a mean over pairs: only the order of sums differs.

    The other terms are means over all correspondences that count, of which pairs have unequal
    numbers, so a mean over processes weighs them a little differently.
    """
    script = tmp_path / "run.py"
    script.write_text(
        "import sys; sys.path.insert(0, 'tests'); import test_train; "
        f"test_train.train_both_ways({str(data)!r}, {str(tmp_path / 'two')!r})"
    )
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node"]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    subprocess.run(
        [*command, "2", str(script)], check=True, cwd=REPOSITORY, env=environment, timeout=300
    )
    train_both_ways(data, tmp_path / "one")
    for name, tolerance in (("rotation", 1e-5), ("all", 5e-3)):
        one, two = (losses(tmp_path / n / name) for n in ("one", "two"))
        assert len(one) == 3
        assert two == pytest.approx(one, rel=tolerance)  # of equal length: one process writes


def train_both_ways(data: Path | str, out: Path | str) -> None:
    """With the rotation loss alone, and with all terms."""
    torch.set_num_threads(1)
    alone = {"teacher": "none", "loss": LossWeights(matching=0)}
    train.train(training(Path(data), Path(out) / "rotation", **alone))
    train.train(training(Path(data), Path(out) / "all"))


def test_a_loss_that_is_not_finite_stops_and_leaves_the_batch(data, tmp_path, monkeypatch):
    def broken(*_: object, weight: float) -> torch.Tensor:
        return torch.tensor(float("nan"), requires_grad=True)

    monkeypatch.setattr(train, "rotation_loss", broken)
    with pytest.raises(UserError, match=r"loss is nan, expected a finite number. Its batch is in"):
        train.train(training(data, tmp_path))
    with safe_open(tmp_path / "bad_batch.safetensors", framework="pt") as file:
        assert file.get_tensor("left").shape == (2, 3, 32, 64)
        assert len(json.loads(file.metadata()["names"])) == 2


def test_minutes_end_a_run_with_a_checkpoint(data, tmp_path):
    train.train(training(data, tmp_path, minutes=1e-6, max_steps=1000))
    assert torch.load(tmp_path / loop.CHECKPOINT, weights_only=True)["step"] == 1


def test_minutes_count_the_runs_that_a_run_goes_on_from(data, tmp_path, monkeypatch):
    """By a clock that goes on by half a minute whenever it is read."""
    ticks = count(0, 30)
    monkeypatch.setattr(loop, "time", SimpleNamespace(monotonic=lambda: next(ticks)))
    ends = []
    for minutes in (1, 3, 3):
        train.train(training(data, tmp_path, minutes=minutes, max_steps=1000))
        ends.append(torch.load(tmp_path / loop.CHECKPOINT, weights_only=True))
    steps, hours = ([end[name] for end in ends] for name in ("step", "hours"))
    assert steps[0] < steps[1] == steps[2]
    assert 3 <= 60 * hours[1] == 60 * hours[2] < 5


def test_a_gradient_that_is_not_finite_spares_weights_and_checkpoint(data, tmp_path, monkeypatch):
    train.train(training(data, tmp_path, max_steps=1))
    before = (tmp_path / "last.safetensors").read_bytes()
    exact = train.rotation_loss

    def steep(R_gt: torch.Tensor, R: torch.Tensor, *, weight: float) -> torch.Tensor:
        R.register_hook(lambda gradient: gradient * torch.inf)
        return exact(R_gt, R, weight=weight)

    monkeypatch.setattr(train, "rotation_loss", steep)
    with pytest.raises(UserError, match=r"the gradient is (nan|inf)"):
        train.train(training(data, tmp_path / "second", max_steps=1))
    assert not (tmp_path / "second" / loop.CHECKPOINT).exists()
    with safe_open(tmp_path / "second" / "bad_batch.safetensors", framework="pt") as file:
        assert {"left", "truth.rays_left", "truth.visible"} <= set(file.keys())
    assert (tmp_path / "last.safetensors").read_bytes() == before


def test_the_logged_loss_is_that_of_the_whole_step(data, tmp_path):
    """Four batches of one pair, gathered, are one batch of four; the rotation loss is a mean."""
    alone = {"teacher": "none", "loss": LossWeights(matching=0), "max_steps": 1}
    for name, batch, accumulate in (("four", 4, 1), ("one", 1, 4)):
        loading = Loading(batch=batch, workers=0)
        train.train(
            training(data, tmp_path / name, loading=loading, accumulate=accumulate, **alone)
        )
    assert losses(tmp_path / "one") == pytest.approx(losses(tmp_path / "four"), rel=1e-4)


def test_turns_smaller_than_those_of_the_set_leave_no_border(data, tmp_path):
    """The set's cameras are turned by up to 1°: taking that back moves the window, too."""
    train.train(training(data, tmp_path, augmentation=Augmentation(turn_deg=0.2)))
    assert losses(tmp_path)


def _kept(out: Path) -> float:
    return load_weights(out / "last.safetensors")[1].keep


def test_weights_know_what_priors_they_were_trained_for(data, tmp_path):
    train.train(training(data, tmp_path))
    card = load_weights(tmp_path / "best.safetensors")[1]
    assert all(0.1 < limit < 2.1 for limit in card.prior_range_deg)
    assert (card.preset, card.samples, card.translation) == ("custom", 6, "gt")


def test_weights_know_the_hours_of_all_their_runs(data, tmp_path, monkeypatch):
    """By a clock that goes on by half an hour whenever it is read."""
    ticks = count(0, 1800)
    monkeypatch.setattr(loop, "time", SimpleNamespace(monotonic=lambda: next(ticks)))
    hours = []
    for minutes in (1, 240):  # each stops after one step
        train.train(training(data, tmp_path / "first", max_steps=3, minutes=minutes))
        hours.append(load_weights(tmp_path / "first" / "last.safetensors")[1].hours)
    assert 0.5 <= hours[0] < hours[1]
    given = str(tmp_path / "first" / "last.safetensors")
    train.train(training(data, tmp_path / "second", init=given, max_steps=1))
    assert load_weights(tmp_path / "second" / "last.safetensors")[1].hours > hours[1]


def test_training_starts_from_given_weights(data, tmp_path):
    first = training(data, tmp_path / "first")
    train.train(first)
    second = replace(
        first, out=tmp_path / "second", init=str(first.out / "last.safetensors"), max_steps=1,
        lr=1e-12,
    )  # fmt: skip
    train.train(second)
    a, b = (load_file(o.out / "last.safetensors") for o in (first, second))
    for name, tensor in a.items():
        torch.testing.assert_close(tensor, b[name], rtol=0, atol=1e-9)


def test_other_options_do_not_resume(data, tmp_path):
    train.train(training(data, tmp_path, max_steps=1))
    with pytest.raises(UserError, match=r"other options: lr was 0\.0005, now 0\.1"):
        train.train(training(data, tmp_path, max_steps=1, lr=0.1))


def test_another_division_of_the_pairs_does_not_resume(data, tmp_path):
    train.train(training(data, tmp_path, max_steps=1))
    with pytest.raises(UserError, match="val_pairs was 3, now 6"):
        train.train(training(data, tmp_path, max_steps=1, val_pairs=6))


def test_other_pairs_do_not_resume(data, tmp_path):
    train.train(training(data, tmp_path / "run", max_steps=1))
    larger = road_set(tmp_path / "set", frames=6)
    with pytest.raises(UserError, match="belongs to a run on other pairs"):
        train.train(training(larger, tmp_path / "run", max_steps=1))


def test_the_number_of_workers_may_change(data, tmp_path):
    options = training(data, tmp_path, max_steps=1)
    scores = train.train(options)
    assert train.train(replace(options, loading=Loading(batch=2, workers=1))) == scores


@pytest.mark.parametrize("name", ["val_pairs", "val_every", "accumulate"])
def test_nothing_less_than_one_is_taken(data, tmp_path, name):
    with pytest.raises(UserError, match=f"--{name.replace('_', '-')} 0: expected at least 1"):
        train.train(training(data, tmp_path, **{name: 0}))


def test_fp16_without_a_gpu_is_refused(data, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UserError, match="--precision fp16 needs a GPU, and there is none"):
        train.train(training(data, tmp_path, precision="fp16"))


@pytest.fixture
def fresh_accelerate():
    """Its precision is one for a whole process, unless it is made to forget."""
    AcceleratorState._reset_state(reset_partial_state=True)
    yield
    AcceleratorState._reset_state(reset_partial_state=True)


def test_bf16_trains_and_resumes(data, tmp_path, fresh_accelerate, monkeypatch):
    whole, parts = (
        training(data, tmp_path / n, precision="bf16", max_steps=2, val_pairs=1) for n in "ab"
    )
    train.train(whole)
    with monkeypatch.context() as patch:
        interrupt_after(0, patch)
        train.train(parts)
    assert len(losses(parts.out)) == 1
    train.train(parts)
    assert_same_tensors(whole.out / "last.safetensors", parts.out / "last.safetensors")
    assert AcceleratorState().mixed_precision == "bf16"


def test_a_checkpoint_of_one_gpu_is_read_with_another_number(monkeypatch):
    """Only the state of the GPU that is trained on is kept."""
    generators = {"now": torch.tensor([1, 2], dtype=torch.uint8)}
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_rng_state", lambda: generators["now"])
    monkeypatch.setattr(torch.cuda, "set_rng_state", lambda state: generators.update(now=state))
    state = checkpoint.random_state()
    generators["now"] = torch.tensor([3, 4], dtype=torch.uint8)
    checkpoint.restore_random_state(state)
    assert generators["now"].tolist() == [1, 2]
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    checkpoint.restore_random_state(state)


def test_the_best_weights_are_those_of_the_lowest_score(data, tmp_path, monkeypatch):
    scores = iter([3.0, 1.0, 2.0, 1.5])
    monkeypatch.setattr(train, "validate", lambda *_: {"geodesic_deg": next(scores)})
    train.train(training(data, tmp_path, max_steps=4, val_every=1))
    best, last = (load_weights(tmp_path / f"{n}.safetensors")[1] for n in ("best", "last"))
    assert (best.samples, last.samples) == (4, 8)


def plain_folder(folder: Path, num: int = 3) -> Path:
    """Noise images, and a calibration that says they are rectified."""
    rng = np.random.default_rng(0)
    for side in ("left", "right"):
        (folder / side).mkdir(parents=True)
        for i in range(num):
            image = rng.integers(0, 256, (54, 96, 3), dtype=np.uint8)
            cv2.imwrite(str(folder / side / f"{i}.png"), image)
    K, T = intrinsics((96, 54), 90.0), transform(np.eye(3), np.array([-0.8, 0, 0]))
    opencv.write(folder / "calib.yaml", Calibration(K, K, T, (96, 54)))
    return folder


def test_a_plain_folder_of_rectified_pairs_can_be_trained_on(tmp_path):
    folder = plain_folder(tmp_path / "pairs")
    command = [
        "--preset", "small", "--data", str(folder), "--out", str(tmp_path / "run"),
        "--teacher", "none", "--loss.matching", "0", "--val-pairs", "1", "--max-steps", "2",
        "--loading.batch", "2", "--loading.workers", "0", "--model.input-wh", "64", "32",
        "--model.channels", "16", "--model.blocks", "1", "--model.head-hw", "2", "4",
    ]  # fmt: skip
    assert train.main(command) == 2  # nobody says that the calibration is true
    assert train.main([*command, "--trusted"]) == 0
    assert len(losses(tmp_path / "run")) == 2
    limits = load_weights(tmp_path / "run" / "last.safetensors")[1].prior_range_deg
    assert all(0.1 < limit < 2.1 for limit in limits)


def test_a_list_is_trained_on_with_the_root_of_its_images(data, tmp_path, monkeypatch):
    asked = {}
    monkeypatch.setattr(loop, "open_source", lambda path, **how: asked.update(how, path=path))
    loop.open_pairs(training(tmp_path / "list.csv", tmp_path, root=tmp_path / "images"))
    assert (asked["path"], asked["root"]) == (tmp_path / "list.csv", tmp_path / "images")


def test_an_augmented_vertical_rig_takes_a_step():
    options, sizing = training(Path(), Path()), Sizing(TINY.input_wh, keep=0.85)
    sights = [augmented(painted_pair(seed, vertical=True), sizing, Augmentation(mirror=seed),
                        rng=np.random.default_rng(seed)) for seed in (0, 1)]  # fmt: skip
    batch, net = collate(sights), network().train()
    optimiser = torch.optim.Adam(net.parameters(), lr=1e-4)
    prediction = train.predict(net, batch, options)
    assert prediction.rectification.vertical.all()
    at_truth = train.loss_terms(replace(prediction, R=batch.R), batch, options)
    assert (at_truth["rotation"], at_truth["flow"].item()) == (0, pytest.approx(0, abs=1e-9))
    terms = train.loss_terms(prediction, batch, options)
    assert terms["flow"] > 0.1
    sum(terms.values()).backward()
    optimiser.step()
    assert all(p.isfinite().all() for p in net.parameters())


def test_the_window_is_safe_for_every_rig(tmp_path):
    """The second rig's lens is longer: its turns move the window by more pixels."""
    read = partial(_of_focal_length, {0: 60.0, 1: 120.0})
    options, keeps = training(tmp_path, tmp_path), []
    for items in ([0], [1], [0, 0, 1]):
        pairs = Pairs(items, read, layout="x", fingerprint="", rig=abs)
        keeps.append(loop.largest_safe_keep(pairs, (64, 32), options))
    assert keeps[2] == keeps[1] < keeps[0]


def _of_focal_length(focal_px: dict[int, float], item: int) -> Pair:
    image = np.zeros((54, 96, 3), np.uint8)
    K = np.array([[focal_px[item], 0, 47.5], [0, focal_px[item], 26.5], [0, 0, 1]])
    return Pair(image, image, K, K, None, transform(np.eye(3), np.array([-0.8, 0, 0])))


def test_training_sees_both_directions_and_validation_one(data, tmp_path):
    options = training(data, tmp_path)
    pairs = loop.open_pairs(options)
    train_pairs, val_pairs = loop.divided(pairs, options)
    assert (len(train_pairs), len(val_pairs)) == (18, 3)
    assert [p.name for p in train_pairs[:2]] == [
        "frame 1, cameras 0 and 1", "frame 1, cameras 1 and 0"
    ]  # fmt: skip
    assert [p.name[-7:] for p in val_pairs] == ["0 and 1", "1 and 2", "0 and 2"]
    one_way = replace(options, both_directions=False)
    assert len(loop.divided(pairs, one_way)[0]) == 9


def test_scenes_are_not_divided_between_training_and_validation(data, tmp_path):
    options = training(data, tmp_path, val_pairs=4)
    train_pairs, val_pairs = loop.divided(loop.open_pairs(options), options)
    assert {p.scene for p in train_pairs} == {"1", "2"}
    assert [p.scene for p in val_pairs] == ["3"] * 3 + ["4"] * 3


def test_speed_and_waiting_are_told_after_twenty_steps(tmp_path, capsys):
    """Steps of 2 s, a tenth of it waiting; the first takes longer and does not count."""
    with RunLog(tmp_path, 5, 100, active=True) as log:
        for step in range(6, 30):
            seconds = {"step_s": 60.0 if step == 6 else 2.0, "wait_s": 0.2}
            log.step(step, {"loss": 1.0, **seconds}, epoch_steps=900)
    told = " ".join(capsys.readouterr().out.split())
    assert told.count("2.00 s per step, 10.0% of it waiting for data; 0.50 h per epoch") == 1


def test_waiting_for_data_is_part_of_a_step(data, tmp_path, monkeypatch):
    """By a clock that only data take time of."""
    now = [0.0]
    monkeypatch.setattr(runlog, "time", SimpleNamespace(monotonic=lambda: now[0]))
    watch = runlog.Stopwatch()

    def slow():
        for batch in range(4):
            now[0] += 3.0
            yield batch

    laps = []
    for _ in watch.waiting_for(slow()):
        now[0] += 1.0
        laps.append(watch.lap())
    assert laps == [{"step_s": 4.0, "wait_s": 3.0}] * 4
    train.train(training(data, tmp_path, max_steps=1))
    assert {"step_s", "wait_s"} <= set(json.loads((tmp_path / "metrics.jsonl").read_text()
                                                  .splitlines()[0]))  # fmt: skip


def test_given_weights_bring_their_window(data, tmp_path):
    first = training(data, tmp_path / "first", keep=0.6)
    train.train(first)
    second = replace(
        first, out=tmp_path / "second", init=str(first.out / "last.safetensors"), keep=0.0
    )
    train.train(second)
    card = load_weights(second.out / "last.safetensors")[1]
    assert (card.keep, card.samples) == (0.6, 12)
    with pytest.raises(UserError, match=r"trained with --fit crop --keep 0\.6, not"):
        train.train(replace(second, keep=0.7))


def test_a_damaged_checkpoint_is_refused(data, tmp_path):
    (tmp_path / loop.CHECKPOINT).write_bytes(b"PK not one")
    with pytest.raises(UserError, match=r"is no checkpoint of flowrect\.train"):
        train.train(training(data, tmp_path))


def test_a_set_smaller_than_its_validation_is_refused(data, tmp_path):
    with pytest.raises(UserError, match=r"12 pairs, of which the last 12 are for validation"):
        train.train(training(data, tmp_path, val_pairs=12))


def test_lines_after_the_checkpoint_are_dropped(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"step": 1}\n{"step": 2}\n{"step": 3}\n{"ste')
    keep_lines_until(path, 2)
    assert path.read_text() == '{"step": 1}\n{"step": 2}\n'


def test_the_rate_decays_exponentially_after_its_warm_up():
    options = replace(TRAINING["small"], lr=1.0, lr_final=0.01, warmup_steps=4)
    assert loop.learning_rate(0, 100, options) == pytest.approx(0.25)
    assert loop.learning_rate(50, 100, options) == pytest.approx(0.1)
    assert loop.learning_rate(100, 100, options) == pytest.approx(0.01)


def test_each_preset_trains_its_own_network():
    assert {name: options.model for name, options in TRAINING.items()} == MODELS
    assert {name: options.preset for name, options in TRAINING.items()} == {n: n for n in MODELS}


@pytest.mark.parametrize("arguments", [["--preset", "paper"], ["--data", "x", "--preset=paper"]])
def test_a_preset_that_is_asked_for_is_taken(arguments):
    assert train.choose_preset(arguments) == ("paper", "as asked")


def test_without_a_gpu_the_small_preset_is_taken(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert train.choose_preset(["--data", "x"]) == ("small", "there is no GPU; paper needs one")


def test_with_a_gpu_the_paper_s_network_is_taken(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert train.choose_preset(["--data", "x"]) == ("paper", "there is a GPU")


def test_the_command_without_arguments_looks_for_shards(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert train.main([]) == 2
    assert "shards: no such folder" in capsys.readouterr().err


@pytest.mark.parametrize("preset", ["small", "paper", "vitpose"])
def test_an_overfit_check_has_a_schedule_of_its_own(preset):
    usual = train.parsed(["--data", "x", "--preset", preset], preset)
    check = train.parsed(["--data", "x", "--preset", preset, "--overfit", "4"], preset)
    assert usual.max_steps == 0
    assert (check.max_steps, check.lr, check.overfit) == (250, 1e-3, 4)
    given = ["--data", "x", "--preset", preset, "--overfit=4", "--lr", "7e-4"]
    assert train.parsed(given, preset).lr == 7e-4


def test_an_overfit_check_fails_where_it_misses_its_bar(data, tmp_path, monkeypatch):
    arguments = ["--data", str(data), "--out", str(tmp_path), "--preset", "small", "--overfit", "2"]
    for scores, code in (({"geodesic_deg": 0.3}, 1), ({"geodesic_deg": 0.01}, 0), ({}, 0)):
        monkeypatch.setattr(train, "train", lambda _, scores=scores: scores)
        assert train.main(arguments) == code


def test_the_command_reports_an_absent_set(tmp_path, capsys):
    assert train.main(["--data", str(tmp_path / "nothing"), "--out", str(tmp_path / "run")]) == 2
    assert "no such folder" in capsys.readouterr().err
