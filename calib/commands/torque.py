"""Computes gravity torque at poses, from a model's own inertials or an identified gravity record."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calib.commands.options import ArmOrModel, ChainBase, ChainTip, JsonFile, Store, Tool

if TYPE_CHECKING:
    from gcomp.arm.arm import Arm
    from gcomp.arrays import Array


def torque(
    arm: ArmOrModel,
    q: Annotated[Path, typer.Option(help="CSV file of poses: a header row with columns q_1 … q_n [rad].")],
    base: ChainBase = None,
    tip: ChainTip = None,
    record: Annotated[
        str | None,
        typer.Option(help="Id of a gravity record; default: the model's inertials or, if none, the current record."),
    ] = None,
    tool: Tool = None,
    store: Store = None,
    json_file: JsonFile = None,
) -> None:
    """Compute the holding torque against gravity at each pose of a file, one row for each pose [N·m].

    Example: armlink torque arm.urdf --q poses.csv --json -
    """
    import numpy as np
    from rich.table import Table

    from armlink.commands.output import write_json
    from armlink.commands.plain_console import results
    from armlink.recording.csv_text import load_columns
    from gcomp.gravity.torque import gravity_torque

    described, beta, source = _model(arm, base, tip, record, tool, store)
    poses = load_columns(q, [f"q_{joint + 1}" for joint in range(described.n)])
    answer = gravity_torque(described, beta, poses)
    table = Table("pose", *described.names, title=f"Holding torque [N·m], {source}")
    for number, row in enumerate(answer, start=1):
        table.add_row(str(number), *(f"{value:+.4f}" for value in row))
    if json_file is None or str(json_file) != "-":
        out = results()
        out.print(table)
        pose, joint = divmod(int(np.argmax(np.abs(answer))), described.n)
        largest = f"{answer[pose, joint]:+.4f} N·m at {described.names[joint]} in pose {pose + 1}"
        out.print(f"{len(poses)} poses; the largest holding torque is {largest}")
    write_json(json_file, {"joints": list(described.names), "source": source, "torque": answer.tolist()})


def _model(
    arm: str, base: str | None, tip: str | None, record: str | None, tool: str | None, store: str | None
) -> "tuple[Arm, Array, str]":
    """The arm, its mass moments (2n,) [kg·m], and their origin in words; raises BadInput, Refused."""
    from armlink.errors import BadInput, Refused
    from calib.arm.kinematics import stated_model
    from calib.commands.options import gravity_model
    from calib.commissioning.model_checks import mass_error
    from calib.records.store import RecordStore, way_to

    stated = stated_model(arm, base, tip, tool)
    arm_file = stated.arm_file
    if arm_file is None and record is not None:
        raise BadInput(f"--record {record} needs an arm file, but {arm} is a model file")
    if stated.beta is not None and record is None:
        error = None if stated.placed is None else mass_error(str(stated.path), stated.placed.arm)
        if error is not None:
            raise BadInput(str(error))
        source = arm if arm_file is None or stated.path is None else stated.path.name
        return stated.arm, stated.beta, f"inertials of {source}"
    assert arm_file is not None  # a model file has inertials, and none has a record
    found = gravity_model(arm_file, record, RecordStore(store))
    if found is None:
        raise Refused(
            f"{arm_file.name} {arm_file.serial}: its model has no inertials, and there is no gravity record "
            f"yet: {way_to(arm_file, 'gravity')}"
        )
    return stated.arm, *found
