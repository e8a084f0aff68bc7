"""Single-joint sweeps of an arm, planned, checked and run; continues after an interruption."""

from pathlib import Path
from typing import Annotated

import typer


def sweep(
    arm: Annotated[str, typer.Argument(help="Bundled arm or path of an arm file.")],
    out: Annotated[Path | None, typer.Option(help="Directory of the data set, new or empty.")] = None,
    bus: Annotated[str | None, typer.Option(help="INTERFACE:CHANNEL[@BITRATE], instead of the arm file's.")] = None,
    reference_mass: Annotated[
        float, typer.Option(min=0.0, help="Mass now attached to the tip [kg]; 0 for the pass without.")
    ] = 0.0,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the data set in --out.")] = False,
    plan: Annotated[
        bool, typer.Option("--plan", help="Print the plan from the arm file alone; nothing moves.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the plan's search.")] = 0,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write plan or outcome here; - is standard output.")
    ] = None,
) -> None:
    """Sweep every joint, tip to base, and write each reading to disk before the next.

    One pass without a load, one with a reference mass attached: two directories for `armlink calibrate`.

    Example: armlink sweep sarcos --bus socketcan:vcan0 --out unloaded
    """
    from armlink.armfile import load_arm
    from armlink.commands.output import write_json
    from armlink.errors import BadInput
    from armlink.link import Link
    from calib.commands.screen import SweepScreen, print_plan
    from calib.plan import plan_sweep
    from calib.runner import run_sweep

    arm_file = load_arm(arm)
    if plan:
        planned = plan_sweep(arm_file, seed=seed)
        print_plan(arm_file, planned)
        write_json(json_file, planned.model_dump(mode="json"))
        return
    if out is None:
        raise BadInput("sweep: give --out DIR for the data set, or --plan to print the plan alone")
    with Link.open(arm_file, bus) as link:
        link.start()
        with SweepScreen(f"{arm_file.name}, {reference_mass:g} kg attached") as screen:
            link.enable()
            data = run_sweep(
                link, arm_file, out, reference_mass=reference_mass, resume=resume, progress=screen.update, seed=seed
            )
    assert data.plan is not None
    print_plan(arm_file, data.plan)
    if not reference_mass:
        screen.say(
            f"{out} is complete. Now attach {data.plan.reference_mass:g} kg and sweep again with"
            f" --reference-mass {data.plan.reference_mass:g} into another directory."
        )
    answer = {
        "out": str(out),
        "arm": arm_file.name,
        "serial": arm_file.serial,
        "readings": len(data.readings),
        "unsettled": sum(not reading.settled for reading in data.readings),
        "seconds": data.readings[-1].t,
        "reference_mass": reference_mass,
        "recommended_reference_mass": data.plan.reference_mass,
        "plan": data.plan.model_dump(mode="json"),
    }
    write_json(json_file, answer)
