"""``ems train``: learn offline from bags."""

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from tractor_ems.cli.output import NOTES, JsonFlag, print_json, print_result


def train(
    bags: Annotated[
        list[Path], typer.Option(help="Bags, or folders of bags; repeatable, or several at once.")
    ],
    out: Annotated[Path, typer.Option(help="Policy file to write (.safetensors).")],
    rule_bags: Annotated[
        list[Path] | None, typer.Option(help="Rule-based bags for the seeding of `sampled`.")
    ] = None,
    preset: Annotated[
        str | None, typer.Option(help="config/training name or YAML file with every setting.")
    ] = None,
    targets: Annotated[
        str | None,
        typer.Option(
            help="counterfactual (default), run_or_stand (engines that start slowly: preset "
            "field) or sampled (the paper's way)."
        ),
    ] = None,
    reward: Annotated[
        str | None,
        typer.Option(help="equivalent_fuel (default), fuel, piecewise or piecewise_corrected."),
    ] = None,
    powertrain: Annotated[str | None, typer.Option(help="Shipped name or YAML file.")] = None,
    updates: Annotated[int | None, typer.Option(help="Gradient steps.")] = None,
    seed: Annotated[int | None, typer.Option(help="Of every generator.")] = None,
    interact: Annotated[
        int | None, typer.Option(help="Simulated episodes to add; none are needed.")
    ] = None,
    rule_share: Annotated[
        float | None,
        typer.Option(help="Replay share of rule-based bags, 0..1; 0.25 with --rule-bags."),
    ] = None,
    allow_other_powertrain: Annotated[
        bool, typer.Option(help="Learn from the demand in bags recorded on another powertrain.")
    ] = False,
    allow_held_out: Annotated[
        bool, typer.Option(help="Learn from bags of held-out cycles; scores on those then lie.")
    ] = False,
    signals: Annotated[
        str | None,
        typer.Option(help="Signal map of a vehicle's bags: name, or YAML file (config/signals*)."),
    ] = None,
    namespace: Annotated[
        str | None, typer.Option(help="Of the map's topics; default the only one that fits.")
    ] = None,
    resume: Annotated[
        bool, typer.Option(help="Go on from an interrupted run's checkpoint.")
    ] = False,
    tensorboard: Annotated[Path | None, typer.Option(help="Folder for TensorBoard logs.")] = None,
    json: JsonFlag = False,
) -> None:
    """Train a double DQN offline from recorded bags and write a policy file.

    With --signals the bags are sampled every step of the powertrain (--powertrain
    paper:dt_s=0.1 for 10 Hz), and so will the policy.

    Ctrl-C leaves a checkpoint beside the output; --resume goes on from it and gives the same
    bytes as a run that was never interrupted.
    """
    from tractor_ems.learning.config import load_train_config, preset_of, rule_share_of
    from tractor_ems.learning.train import train as run
    from tractor_ems.signals.config import optional_map

    overrides: dict[str, Any] = {
        "targets": targets,
        "reward.kind": reward,
        "powertrain": powertrain,
        "seed": seed,
        "updates": updates,
        "interact": interact,
        "sampled.rule_share": rule_share_of(rule_share, rule_bags),
        "allow_other_powertrain": True if allow_other_powertrain else None,
        "allow_held_out": True if allow_held_out else None,
    }
    config = load_train_config(preset or preset_of(targets), overrides)
    with Progress(
        TextColumn("training"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
        console=NOTES,
        transient=True,
        disable=not NOTES.is_terminal,
    ) as bar:
        task = bar.add_task("", total=config.updates)

        def show(step: int, metrics: dict[str, float]) -> None:
            loss = metrics.get("losses/td_loss")
            bar.update(
                task, completed=step, description="" if loss is None else f"loss {loss:.4g}"
            )

        report = run(
            config,
            bags,
            rule_bags or [],
            out,
            progress=show,
            resume=resume,
            tensorboard=tensorboard,
            signals=optional_map(signals, namespace),
            namespace=namespace,
        )
    if json:
        print_json(report.to_json())
        return
    print_result(report.to_json())
