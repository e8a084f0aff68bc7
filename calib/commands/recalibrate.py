"""Finds torque sensor gains and offsets in the field, without a mass, from slow motion and the gravity record."""

import getpass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from armlink.commands.options import Arm
from calib.commands.options import Bus, Check, Flash, JsonFile, Replaced, Store, Tool

if TYPE_CHECKING:
    from armlink.arm_file import ArmFile
    from armlink.commands.plain_console import PlainConsole
    from calib.fit.field_fit import FieldFit
    from calib.records.records import CalibrationRecord
    from gcomp.identify.readings import StaticReadings


def recalibrate(
    arm: Arm,
    data: Annotated[
        list[Path], typer.Argument(help="Recordings of slow motion or of an arm at rest, or sweep directories.")
    ],
    held: Annotated[
        Literal["record", "raw"],
        typer.Option(
            help="Calibration in the drives during the recording: the gains and offsets of the current record, "
            "or gain 1 and offset 0."
        ),
    ] = "record",
    apply: Annotated[bool, typer.Option("--apply", help="Also write gains and offsets to the drives.")] = False,
    bus: Bus = None,
    check: Check = True,
    flash: Flash = False,
    replaced: Replaced = None,
    tool: Tool = None,
    store: Store = None,
    json_file: JsonFile = None,
) -> None:
    """Find gains and offsets from the current gravity record, and store them; --apply also makes them current.

    The arm must carry no more than its tool; every joint must move slowly (below 0.1 rad/s), in both directions, or
    rest.

    Example: armlink recalibrate sarcos slow.mcap --json -
    """
    from armlink.arm_file import load_arm
    from armlink.commands.early_end import early_end
    from armlink.commands.output import write_json
    from armlink.commands.plain_console import command_line, results, suggest
    from calib.arm.kinematics import with_tool
    from calib.fit.field_fit import fit_field
    from calib.records.records import CalibrationRecord, GravityRecord
    from calib.records.store import RecordStore

    arm_file, records = with_tool(load_arm(arm), tool), RecordStore(store)
    gravity, before = records.required(GravityRecord, arm_file), records.current(CalibrationRecord, arm_file)
    rows, sources = _rows(arm_file, data, before if held == "record" else None)
    fit = fit_field(arm_file, rows, gravity, before, {**sources, f"gravity record {gravity.id}": gravity.id})
    record = fit.record(arm_file, before)
    out = results(json_file)
    _show(fit, out)
    given = {"held": None if held == "record" else held, "bus": bus, "tool": tool, "store": store}
    apply_it = command_line("recalibrate", arm, *map(str, data), "--apply", **given)
    if apply:
        import numpy as np

        from calib.fit.field_fit import held_out_rows
        from calib.install.apply import Apply, apply_record
        from calib.install.plausibility import replaced_record

        user = getpass.getuser()
        record = record.model_copy(update={"confirmed_by": user})
        replaces = replaced_record(record, arm_file, records)
        if replaces is not None:
            record = record.model_copy(update={"held_out": held_out_rows(record, rows, fit, replaces)})
        how = Apply(by=user, bus=bus, replaced=tuple(replaced or ()), check=check, flash=flash)
        with early_end(arm_file, apply_it) as work:
            work.enabled = check
            written = apply_record(
                record, arm_file, records, how, np.array(gravity.carrying(arm_file).beta), "slow motion"
            )
        out.print(f"record {record.id} is current; it was written to {len(written)} drives and read back")
    else:
        records.add(record)
        out.print(
            f"record {record.id} is stored; the drives keep their old calibration until `--apply` writes this "
            "record to them"
        )
        suggest(apply_it)
    write_json(json_file, _answer(fit, record, gravity.id, apply))


def _rows(
    arm_file: "ArmFile", data: list[Path], held: "CalibrationRecord | None"
) -> "tuple[StaticReadings, dict[str, str]]":
    """Rows of all recordings and sweeps, and the SHA-256 of each source."""
    import hashlib

    from armlink.errors import BadInput
    from armlink.recording.files import load_recording
    from armlink.torque_calibration import UNCALIBRATED, per_joint
    from calib.dataset import labels, load_data
    from calib.fit.recorded_rows import rows_of_recording, rows_of_sweeps

    n = len(arm_file.joint_names)
    blank = per_joint([UNCALIBRATED] * n)
    installed = blank if held is None else held.torque_calibration(blank)
    parts, sources = [], dict[str, str]()
    for number, (path, label) in enumerate(zip(data, labels(data), strict=True)):
        if path.is_dir():
            sweeps = load_data(path).require(arm_file)
            parts.append(rows_of_sweeps(sweeps, number))
            digest = sweeps.digest
        else:
            recording = load_recording(path)
            if recording.n != n:
                raise BadInput(f"{path}: the recording has {recording.n} joints, but {arm_file.name} has {n}")
            parts.append(rows_of_recording(recording, installed, number, str(path)))
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
        if digest in sources.values():
            twin = next(name for name, known in sources.items() if known == digest)
            raise BadInput(f"{path} contains the same data as {twin}, which would count twice: leave one out")
        sources[label] = digest
    return parts[0].joined(*parts[1:]), sources


def _answer(fit: "FieldFit", record: "CalibrationRecord", gravity: str, applied: bool) -> dict[str, Any]:
    import numpy as np

    return {
        "schema": "armlink.field/1",
        "record": record.id,
        "gravity_record": gravity,
        "applied": applied,
        "joints": list(fit.names),
        **{key: {"estimated": fit.value(key).tolist(), "ci95": fit.ci95(key).tolist()} for key in ("gain", "offset")},
        "hysteresis": fit.hysteresis.tolist(),
        "common_scale_std": fit.common_scale_std,
        "not_separable": [
            {"joint": joint, "parameter": parameter, "reason": reason}
            for (joint, parameter), reason in fit.reasons.items()
        ],
        "rows": np.isfinite(fit.residual).sum(axis=0).tolist(),
    }


def _show(fit: "FieldFit", console: "PlainConsole") -> None:
    from calib.commands.screen import print_intervals, print_lines

    columns = {
        "gain": (fit.value("gain"), fit.half95("gain")),
        "offset [N·m]": (fit.value("offset"), fit.half95("offset")),
        "hysteresis [N·m]": (fit.hysteresis, 0 * fit.hysteresis),
    }
    print_intervals("Sensors in the field, ± half of the 95 % interval", fit.names, columns, console)
    lines = [f"{joint} {parameter}: {reason}" for (joint, parameter), reason in fit.reasons.items()]
    lines.append(
        f"a factor common to all gains is known to ± {1.96 * fit.common_scale_std:.2%} only (this is part of "
        "the intervals), since these readings do not separate it from the scale of the gravity record"
    )
    print_lines(lines, console=console)
