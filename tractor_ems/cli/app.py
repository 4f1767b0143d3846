"""The subcommands, wired."""

import typer

from tractor_ems.cli import bag, cycle, demo, dp, evaluate, policy, study, train, tune, vehicle

app = typer.Typer(
    name="ems",
    help="Energy management of series hybrid tractors: evaluate, optimise, learn from bags.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    rich_markup_mode=None,
)
app.command("demo")(demo.demo)
app.command("train")(train.train)
app.command("evaluate")(evaluate.evaluate)
app.command("dp")(dp.dp)
app.add_typer(cycle.app, name="cycle")
app.add_typer(bag.app, name="bag")
app.add_typer(policy.app, name="policy")
app.add_typer(study.app, name="study")
app.add_typer(tune.app, name="tune")
app.add_typer(vehicle.app, name="vehicle")
