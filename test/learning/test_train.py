"""Training runs from bags: repeatable and resumable to the byte, and clear about bad input."""

import json
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
import torch
import yaml

from tractor_ems.learning.checkpoint import checkpoint_path
from tractor_ems.learning.config import TrainConfig, learning_rate, load_train_config
from tractor_ems.learning.counterfactual import CounterfactualLearner
from tractor_ems.learning.recordings import Recordings, read_recordings
from tractor_ems.learning.train import train, train_on
from tractor_ems.policies.q_policy import load_policy
from tractor_msgs_py.errors import BagError, ConfigError, RunAborted
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.library import cycle_names
from tractor_sim.powertrain_json import powertrain_hash
from tractor_sim.resources import resource_path

CONFIGS = {
    "counterfactual": TrainConfig(
        **{"counterfactual": {"updates": 60, "batch": 32, "hidden": (16,)}, "checkpoint_every": 25}
    ),
    "sampled": load_train_config(
        "sampled",
        {
            "updates": 60,
            "sampled.batch": 16,
            "sampled.hidden": [16],
            "sampled.rule_share": 0.25,
            "sampled.replay_capacity": 400,
            "interact": 3,
            "checkpoint_every": 25,
        },
    ),
}
NAN = float("nan")
MODES = pytest.mark.parametrize("mode", CONFIGS)

RESUME = """
import sys
from pathlib import Path
from test_train import CONFIGS, run
bags, folder = Path(sys.argv[1]), Path(sys.argv[2])
for mode in CONFIGS:
    print(run(mode, bags, folder / f"{mode}.safetensors", resume=True).updates)
"""


def run(mode: str, bags: Path, out: Path, **options: object):
    return train(
        CONFIGS[mode],
        [bags / "best"],
        [bags / "rule"],
        out,
        command_line="x",
        **options,  # type: ignore[arg-type]
    )


@MODES
def test_same_seed_same_bytes_and_another_seed_others(mode: str, bags: Path, tmp_path: Path):
    first, second, third = (tmp_path / f"{name}.safetensors" for name in "abc")
    run(mode, bags, first)
    run(mode, bags, second)
    assert first.read_bytes() == second.read_bytes()
    other = replace(CONFIGS[mode], seed=1)
    train(other, [bags / "best"], [bags / "rule"], third, command_line="x")
    assert (
        load_policy(first).net.weights[0].tobytes() != load_policy(third).net.weights[0].tobytes()
    )


@pytest.mark.slow
def test_resumed_runs_equal_unbroken_ones_to_the_byte(bags: Path, tmp_path: Path):
    """Interrupted after 30 of 60 updates, resumed in a process of its own; both modes."""
    for mode in CONFIGS:
        run(mode, bags, tmp_path / f"whole_{mode}.safetensors")
        out, asked = tmp_path / f"{mode}.safetensors", iter(range(1, 100))
        report = run(mode, bags, out, stop=lambda asked=asked: next(asked) == 30)
        assert (report.updates, report.policy) == (30, None)
        assert report.checkpoint == str(checkpoint_path(out))
        assert not out.exists()
    done = subprocess.run(
        [sys.executable, "-c", RESUME, str(bags), str(tmp_path)],
        cwd=Path(__file__).parent,
        text=True,
        capture_output=True,
        timeout=240,
    )
    assert done.stdout.split() == ["60", "60"], done.stdout + done.stderr
    for mode in CONFIGS:
        out = tmp_path / f"{mode}.safetensors"
        assert out.read_bytes() == (tmp_path / f"whole_{mode}.safetensors").read_bytes()
        assert not checkpoint_path(out).exists()


def test_ctrl_c_waits_for_the_update_and_leaves_a_checkpoint(bags: Path, tmp_path: Path):
    config = replace(CONFIGS["counterfactual"], checkpoint_every=10_000)
    config = replace(config, counterfactual=replace(config.counterfactual, updates=500))
    whole, out = tmp_path / "whole.safetensors", tmp_path / "p.safetensors"
    train(config, [bags / "best"], [], whole, command_line="x")

    def interrupt(step: int, _metrics: dict[str, float]) -> None:
        if step == 200:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        train(config, [bags / "best"], [], out, progress=interrupt, command_line="x")
    assert checkpoint_path(out).is_file() and not out.exists()
    train(config, [bags / "best"], [], out, resume=True, command_line="x --resume")
    assert out.read_bytes() == whole.read_bytes()
    steps = [json.loads(line)["step"] for line in (tmp_path / "p.jsonl").read_text().splitlines()]
    assert steps == [100, 200, 300, 400, 500]


def test_a_run_killed_before_its_policy_was_written_resumes_to_the_same_bytes(
    bags: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The last checkpoint may hold the last update: its loss is known to nothing else."""
    config = replace(CONFIGS["counterfactual"], checkpoint_every=20)
    whole, out = tmp_path / "whole.safetensors", tmp_path / "p.safetensors"
    train(config, [bags / "best"], [], whole, command_line="x")

    def killed(*_: object) -> None:
        raise InterruptedError

    with monkeypatch.context() as patch:
        patch.setattr("tractor_ems.learning.experiment.save_policy", killed)
        with pytest.raises(InterruptedError):
            train(config, [bags / "best"], [], out, command_line="x")
    train(config, [bags / "best"], [], out, resume=True, command_line="x --resume")
    assert out.read_bytes() == whole.read_bytes()
    assert load_policy(out).metadata["training"]["final_td_loss"] is not None


@pytest.mark.parametrize("every", [1, 10_000])
def test_a_diverged_run_is_aborted_before_it_can_be_saved(every: int, bags: Path, tmp_path: Path):
    config = replace(CONFIGS["counterfactual"], checkpoint_every=every)
    out = tmp_path / "p.safetensors"
    with pytest.MonkeyPatch.context() as patch:
        update = CounterfactualLearner.update

        def diverge(learner: CounterfactualLearner):
            metrics = update(learner)
            return metrics if learner.step < 7 else metrics | {"losses/td_loss": torch.tensor(NAN)}

        patch.setattr(CounterfactualLearner, "update", diverge)
        with pytest.raises(RunAborted, match="diverged at update 7: loss is nan"):
            train(config, [bags / "best"], [], out)
    assert not out.exists()
    assert checkpoint_path(out).exists() == (every == 1)


def test_weights_that_are_not_finite_reach_no_checkpoint(
    bags: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The loss of an update is that before its step, so the step can break what it praised."""
    update = CounterfactualLearner.update

    def poison(learner: CounterfactualLearner):
        metrics = update(learner)
        with torch.no_grad():
            learner.online.parameters()[0].fill_(NAN)
        return metrics

    monkeypatch.setattr(CounterfactualLearner, "update", poison)
    out = tmp_path / "p.safetensors"
    with pytest.raises(RunAborted, match="diverged at update 1"):
        run("counterfactual", bags, out, stop=lambda: True)
    assert not checkpoint_path(out).exists()


def test_the_size_of_a_spike_of_demand_changes_no_weight(make_traces, paper, tmp_path: Path):
    quiet = make_traces([25], steps=200)[0]

    def network(spike_w: float, mode: str) -> bytes:
        demand_w = quiet.power_demand_w.copy()
        demand_w[50] = spike_w
        recordings = Recordings(dp=(replace(quiet, power_demand_w=demand_w),), rule=())
        out = tmp_path / "p.safetensors"
        config = replace(CONFIGS[mode], interact=0)
        train_on(config, paper, recordings, out)
        return load_policy(out).net.weights[0].tobytes()

    for mode in CONFIGS:
        assert network(1e14, mode) == network(1e9, mode)
        assert network(-1e14, mode) == network(-1e9, mode)


@pytest.mark.slow
def test_the_order_and_names_of_bags_decide_nothing(bags: Path, tmp_path: Path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    for source, first, second in (("best", "a/1", "b/2"), ("rule", "a/2", "b/1")):
        shutil.copytree(bags / source, tmp_path / first)
        shutil.copytree(bags / source, tmp_path / second)
    config = replace(CONFIGS["sampled"], sampled=replace(CONFIGS["sampled"].sampled, dp_share=0.5))
    files = []
    for name in ("a", "b"):
        out = tmp_path / f"{name}.safetensors"
        given = sorted((tmp_path / name).iterdir())
        paper = load_powertrain("paper")
        read = read_recordings(given, [], paper)
        swapped = read_recordings(given[::-1], [], paper)
        assert [t.bag_hash for t in read.traces] == [t.bag_hash for t in swapped.traces]
        train(config, given, [], out, command_line="x")
        files.append(out.read_bytes())
    assert files[0] == files[1]


def test_an_output_that_is_no_policy_file_is_refused_before_training(bags: Path, tmp_path: Path):
    folder = tmp_path / "folder.safetensors"
    folder.mkdir()
    for out in (tmp_path / "policy", tmp_path, folder):
        with pytest.raises(ConfigError, match=str(out)):
            run("counterfactual", bags, out)
    assert [path.name for path in tmp_path.iterdir()] == ["folder.safetensors"]


def test_a_policy_file_says_where_it_came_from(bags: Path, tmp_path: Path):
    out = tmp_path / "p.safetensors"
    report = run("counterfactual", bags, out)
    metadata = load_policy(out).metadata
    assert metadata["bag_hashes"] == report.bags and len(report.bags) == 2
    assert len(metadata["cycle_hashes"]) == 1 and metadata["cycles"] == ["short"]
    assert metadata["powertrain_hash"] == powertrain_hash(load_powertrain("paper"))
    assert metadata["seed"] == 0 and metadata["command_line"] == "x"
    assert metadata["reward"]["lambda0_kg_per_j"] == pytest.approx(1 / (0.437 * 42.8e6))
    assert metadata["training"]["updates"] == 60
    assert TrainConfig(**metadata["config"]) == CONFIGS["counterfactual"]


def test_two_recordings_of_one_demand_are_one_experience_of_it(bags: Path, tmp_path: Path):
    report = run("counterfactual", bags, tmp_path / "p.safetensors")
    assert report.details["demand_ticks"] == 120


def test_the_report_tells_what_seeded_the_replay(bags: Path, tmp_path: Path):
    report = run("sampled", bags, tmp_path / "p.safetensors")
    seeding = report.details["seeding"]
    assert seeding["dp"] == {
        "wanted": 100,
        "available": 119,
        "distinct": 119,
        "seeded": 100,
        "share": 0.25,
    }
    assert seeding["rule"]["seeded"] == 100 and report.details["episodes"] == 3
    assert json.loads(json.dumps(report.to_json())) == report.to_json()


def test_provenance_keeps_rule_based_runs_out_of_the_dp_share(bags: Path, tmp_path: Path):
    """One folder with both: the recordings themselves say who drove."""
    report = train(CONFIGS["sampled"], [bags], [], tmp_path / "p.safetensors")
    assert report.details["seeding"]["dp"]["available"] == 119
    assert report.details["seeding"]["rule"]["available"] == 119


def test_the_log_has_one_json_object_per_report(bags: Path, tmp_path: Path):
    out, seen = tmp_path / "p.safetensors", []
    run("counterfactual", bags, out, progress=lambda step, metrics: seen.append((step, metrics)))
    lines = [json.loads(line) for line in (tmp_path / "p.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [step for step, _ in seen] == [60]
    names = {"losses/td_loss", "losses/q_values", "charts/SPS", "charts/learning_rate"}
    assert names <= set(lines[0])


def test_tensorboard_logs_are_written_where_asked(bags: Path, tmp_path: Path):
    pytest.importorskip("tensorboard")
    run("counterfactual", bags, tmp_path / "p.safetensors", tensorboard=tmp_path / "tb")
    assert list((tmp_path / "tb").glob("events.*"))


def test_demand_only_traces_teach_counterfactual_and_not_sampled(make_traces, paper, tmp_path):
    nothing = dict.fromkeys(
        ("soc", "battery_power_w", "engine_power_w", "engine_on", "time_in_state_s", "fuel_kg",
         "shortfall_j", "dissipated_j", "soc_target")
    )  # fmt: skip
    trace = replace(make_traces([25], steps=200)[0], **nothing, powertrain_hash="", policy="")
    recordings = Recordings(dp=(trace,), rule=())
    out = tmp_path / "p.safetensors"
    assert train_on(CONFIGS["counterfactual"], paper, recordings, out).policy == str(out)
    offline = replace(CONFIGS["sampled"], interact=0)
    with pytest.raises(ConfigError, match="no driven run"):
        train_on(offline, paper, recordings, tmp_path / "q.safetensors")


def test_simulated_episodes_alone_are_enough(paper, tmp_path: Path):
    nothing = Recordings(dp=(), rule=())
    for mode, config in CONFIGS.items():
        out = tmp_path / f"{mode}.safetensors"
        report = train_on(replace(config, interact=2), paper, nothing, out)
        assert report.policy == str(out)
        assert report.cycles and set(report.cycles) <= set(cycle_names("train"))


def test_nothing_to_learn_from_is_refused(tmp_path: Path):
    with pytest.raises(ConfigError, match="no bags given"):
        train(CONFIGS["counterfactual"], [], [], tmp_path / "p.safetensors")
    assert list(tmp_path.iterdir()) == []


def test_bags_of_another_powertrain_are_refused_unless_allowed(bags: Path, tmp_path: Path):
    text = resource_path("config", "powertrain", "paper.yaml").read_text()
    data = yaml.safe_load(text)
    data["battery"]["soc_min"] = 0.6
    other = tmp_path / "other.yaml"
    other.write_text(yaml.safe_dump(data))
    config = replace(CONFIGS["counterfactual"], powertrain=str(other))
    out = tmp_path / "p.safetensors"
    with pytest.raises(BagError, match="recorded on powertrain paper"):
        train(config, [bags / "best"], [], out)
    assert not out.exists()
    allowed = replace(config, allow_other_powertrain=True)
    assert train(allowed, [bags / "best"], [], out).policy == str(out)


def test_a_checkpoint_of_another_run_is_refused_by_what_differs(bags: Path, tmp_path: Path):
    out = tmp_path / "p.safetensors"
    run("counterfactual", bags, out, stop=lambda: True)
    other = replace(CONFIGS["counterfactual"], seed=9)
    with pytest.raises(ConfigError, match="config differs"):
        train(other, [bags / "best"], [bags / "rule"], out, resume=True)
    with pytest.raises(ConfigError, match="rule_bag_hashes differs"):
        train(CONFIGS["counterfactual"], [bags / "best"], [], out, resume=True)


def test_a_missing_or_damaged_checkpoint_is_one_line(bags: Path, tmp_path: Path):
    out = tmp_path / "p.safetensors"
    with pytest.raises(ConfigError, match="no checkpoint to resume"):
        run("counterfactual", bags, out, resume=True)
    run("counterfactual", bags, out, stop=lambda: True)
    saved = checkpoint_path(out)
    saved.write_bytes(saved.read_bytes()[:-50])
    with pytest.raises(ConfigError, match="damaged checkpoint"):
        run("counterfactual", bags, out, resume=True)


@pytest.mark.parametrize(
    ("overrides", "named"),
    [
        ({"sampled.updat": 5}, "sampled.updat"),
        ({"bogus": 1}, "bogus"),
        ({"seed": -1}, "seed"),
        ({"reward.kind": "profit"}, "reward.kind"),
        ({"reward.kp": -1.0}, "reward.kp"),
        ({"sampled.gamma": 1.0}, "sampled.gamma"),
        ({"sampled.hidden": []}, "sampled.hidden"),
        ({"sampled": 3}, "sampled"),
        ({"sampled.dp_share": 0.9, "sampled.rule_share": 0.2}, "rule_share"),
    ],
)
def test_a_wrong_setting_is_named_with_its_file(overrides: dict[str, object], named: str):
    with pytest.raises(ConfigError) as caught:
        load_train_config("sampled", overrides)
    assert named in str(caught.value) and "sampled.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_presets_are_the_defaults_of_their_mode():
    assert load_train_config("counterfactual") == TrainConfig()
    assert load_train_config("sampled") == replace(TrainConfig(), targets="sampled")
    with pytest.raises(ConfigError, match="shipped are: counterfactual, field, field_unpl"):
        load_train_config("fast")


def test_the_learning_rate_is_held_then_lowered_to_its_final_fraction():
    mode = replace(TrainConfig().counterfactual, updates=1000)
    rates = [learning_rate(mode, step) for step in range(1001)]
    assert rates[:501] == [2e-3] * 501
    assert all(a > b for a, b in pairwise(rates[500:]))
    assert rates[1000] == pytest.approx(0.02 * 2e-3)


def test_starting_a_run_is_what_imports_torch():
    code = "import sys, tractor_ems.learning.train; print('torch' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], text=True, capture_output=True, timeout=120
    )
    assert done.stdout.strip() == "False", done.stderr
