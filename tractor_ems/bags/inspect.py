"""What is in a bag, as plain JSON data. Judging it is ``check``'s job."""

from pathlib import Path
from typing import Any

from tractor_ems.bags.plain_yaml import parse_yaml
from tractor_ems.bags.read import bag_hash, provenance_of, read_bag, storage_file
from tractor_ems.bags.runs import Run, trajectory_of
from tractor_ems.bags.scan import scan_mcap
from tractor_msgs_py.trajectory import trajectory_hash


def info(path: Path) -> dict[str, Any]:
    """Files, topics, provenance and runs of a bag.

    Raises:
        BagError: the bag cannot be read.
    """
    file = storage_file(path)
    runs = read_bag(path)
    channels = scan_mcap(file).channels if file.suffix == ".mcap" else ()
    return {
        "bag": str(path),
        "file": file.name,
        "bytes": file.stat().st_size,
        "sha256": bag_hash(path),
        "provenance": {k: v for k, v in provenance_of(path).items() if k != "runs"},
        "topics": [
            {
                "name": channel.topic,
                "type": channel.type,
                "type_hash": channel.type_hash,
                "qos": _plain_qos(channel.qos),
                "messages": channel.messages,
            }
            for channel in channels
        ],
        "runs": [run_json(run) for run in runs],
    }


def run_json(run: Run) -> dict[str, Any]:
    """One run in numbers; what the recording does not know is null."""
    announced = run.info
    driven = sum(run.driven)
    document: dict[str, Any] = {
        "run_id": announced.run_id if announced else None,
        "namespace": run.namespace,
        "policy": run.policy or None,
        "cycle": announced.cycle if announced else None,
        "cycle_hash": announced.cycle_hash if announced else None,
        "powertrain": announced.powertrain if announced else None,
        "powertrain_hash": announced.powertrain_hash if announced else None,
        "lockstep": announced.lockstep if announced else None,
        "demand_samples": len(run.demand),
        "steps": announced.steps if announced else None,
        "driven_steps": driven,
        "complete": run.complete,
        "gaps": run.gaps,
        "duplicates": run.duplicates,
        "refusals": dict(run.refusals),
        "soc_initial": announced.soc_initial if announced else None,
        "soc_target": announced.soc_target if announced else None,
        "soc_final": None,
        "fuel_kg": None,
        "shortfall_j": None,
        "trajectory_hash": None,
    }
    if driven and not run.gaps:
        trajectory = trajectory_of(run)
        document |= {
            "soc_final": trajectory.soc_final,
            "fuel_kg": float(trajectory.fuel_kg.sum()),
            "shortfall_j": float(trajectory.shortfall_j.sum()),
            "trajectory_hash": trajectory_hash(trajectory),
        }
    return document


def _plain_qos(text: str) -> Any:
    return parse_yaml(text, "offered_qos_profiles") or []
