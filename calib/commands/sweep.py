"""Plans, checks and runs the single-joint sweeps of an arm; continues after an interruption."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from armlink.commands.options import Arm, OtherBus
from calib.commands.options import JsonFile, KeepGoing, WithoutAsking

if TYPE_CHECKING:
    from armlink.arm_file import ArmFile
    from armlink.commands.plain_console import PlainConsole
    from calib.dataset import SweepData
    from calib.sweep.preflight import Preflight


def sweep(
    arm: Arm,
    out: Annotated[Path | None, typer.Option(help="Directory of the data set; new or empty.")] = None,
    bus: OtherBus = None,
    reference_mass: Annotated[
        float, typer.Option(min=0.0, help="Mass that is now attached to the tip [kg]; 0 for the pass without a mass.")
    ] = 0.0,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the data set in --out.")] = False,
    plan: Annotated[
        bool, typer.Option("--plan", help="Only print the plan, from the arm file; nothing moves.")
    ] = False,
    picture: Annotated[
        Path | None, typer.Option(help="With --plan: draw the poses to this HTML file.", rich_help_panel="Plan")
    ] = None,
    hold: Annotated[
        str | None,
        typer.Option(
            help="How joints at rest are held: stops (pressed on a stop) or servo (by their position loops).",
            rich_help_panel="Plan",
        ),
    ] = None,
    check_stops: Annotated[
        bool | None,
        typer.Option(
            "--check-stops/--no-check-stops",
            help="Before the pass without load, push every joint slowly onto both of its stops; by default only where "
            "joints rest on their stops (--hold stops).",
            rich_help_panel="Run",
        ),
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run",
            help="Run the whole plan on the simulated arm that the key sim of the arm file describes.",
            rich_help_panel="Run",
        ),
    ] = False,
    keep_going: KeepGoing = 0,
    yes: WithoutAsking = False,
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of the random search for the plan.", rich_help_panel="Plan")
    ] = 0,
    json_file: JsonFile = None,
) -> None:
    """Sweep every joint, from tip to base, and write each reading to disk before the next reading.

    One pass without a load, one with a reference mass attached: two directories for `armlink calibrate`.

    Example: armlink sweep sarcos --bus socketcan:vcan0 --out unloaded
    """
    from functools import partial

    from armlink.arm_file import SIMULATED, load_arm
    from armlink.commands.early_end import early_end
    from armlink.commands.output import write_json
    from armlink.commands.plain_console import command_line, results, suggest
    from armlink.errors import BadInput
    from armlink.extras import require_extra
    from calib.api import open_link
    from calib.arm.sweep_section import sweep_motion, sweep_section, with_hold
    from calib.commands.screen import SPACE_CLEAR, SweepScreen, confirm, print_lines, warn_late
    from calib.commissioning.model_checks import refuse_impossible_sweep
    from calib.dataset import MANIFEST, new_folder, require_vacant
    from calib.sweep.preflight import find_stops, listen
    from calib.sweep.run import run_sweep
    from calib.sweep.sweep_pass import repeat_work

    if picture is not None:
        require_extra("--picture", "reports")
    arm_file = with_hold(load_arm(arm), hold)
    refuse_impossible_sweep(arm_file, reference_mass)
    if check_stops is None:
        check_stops = sweep_section(arm_file).hold == "stops"
    if plan:
        write_json(json_file, _plan(arm_file, seed, reference_mass, check_stops, picture, results(json_file)))
        simulated = bus is None and arm_file.require_link().bus.interface == SIMULATED
        folder = Path(("rehearsal-" if simulated else "") + ("loaded" if reference_mass else "unloaded"))
        words, mass = [arm, *["--dry-run"] * simulated], f"{reference_mass:g}" if reference_mass else None
        suggest(command_line("sweep", *words, out=new_folder(folder), reference_mass=mass, bus=bus, hold=hold))
        return
    if out is None:
        raise BadInput("sweep: give `--out DIR` for the data set, or `--plan` to print only the plan")
    require_vacant(out, resume)
    motion = f"{arm_file.name} will move through its whole range, {_load(reference_mass)}"
    unasked = confirm(motion, SPACE_CLEAR, dry_run or yes)
    load = reference_mass if dry_run else 0.0

    def going_on() -> str:
        words = [arm, *["--resume"] * (out / MANIFEST).exists(), *["--dry-run"] * dry_run]
        return command_line("sweep", *words, out=out, reference_mass=reference_mass or None, bus=bus, hold=hold)

    of_link = None if dry_run else bus
    opened = open_link(arm_file, of_link, simulated=dry_run, load=load)
    with early_end(arm_file, going_on) as work, opened as link:
        link.start()
        print_lines(unasked)
        work.enabled = True
        with SweepScreen(f"{arm_file.name}, {_load(reference_mass)}") as screen:
            link.enable()
            on_stall = screen.on_stall(keep_going)
            found = heard = repeat_work(link, on_stall, lambda: listen(link, arm_file))
            if check_stops and not resume and not reference_mass and sweep_motion(arm_file) == "steps":
                pushed = partial(screen.count, what="stops, each touched by its joint")
                found = repeat_work(link, on_stall, lambda: find_stops(link, arm_file, heard, pushed))
                for line in found.left_out:
                    screen.say(line)
            data = run_sweep(
                link,
                arm_file,
                out,
                reference_mass=reference_mass,
                resume=resume,
                progress=screen.update,
                seed=seed,
                on_stall=on_stall,
                bus=of_link,
            )
        lateness = link.stats.lateness
    _show(arm_file, found, data, results(json_file), _again(arm, bus, hold, dry_run))
    warn_late(arm_file, lateness)
    write_json(json_file, {**_answer(arm_file, data), "late_ms": lateness.in_ms()})


def _plan(
    arm_file: "ArmFile",
    seed: int,
    reference_mass: float,
    check_stops: bool,
    picture: Path | None,
    console: "PlainConsole",
) -> dict[str, Any]:
    """Print and check the plan, and draw it if asked to; the answer for machines."""
    from calib.arm.sweep_section import sweep_motion
    from calib.commands.screen import print_plan
    from calib.plan.collisions import check_plan
    from calib.plan.creep_plan import creep_seconds, plan_creep
    from calib.plan.drawing import draw_plan, reading_seconds, stops_seconds
    from calib.plan.rough_gravity import guess_of_file
    from calib.plan.sweep_plan import plan_sweep

    answer: dict[str, Any] = {"picture": None if picture is None else str(picture)}
    drawn = "" if picture is None else f"; the poses are drawn in {picture}"
    if sweep_motion(arm_file) == "creep":
        planned = plan_creep(arm_file, seed=seed)
        took = answer["seconds"] = float(creep_seconds(planned).sum())
        told = f"{len(planned.sweeps)} creep sweeps in both directions, about {_minutes(took)} for each pass{drawn}"
    else:
        planned = plan_sweep(arm_file, guess_of_file(arm_file), seed=seed, reference_mass=reference_mass)
        took, checked = float(reading_seconds(arm_file, planned).sum()), check_plan(arm_file, planned)
        answer |= {"seconds": took, "collisions": checked}
        told = f"about {_minutes(took)} for the pass {_load(reference_mass)}"
        if check_stops:
            told += f", {_minutes(stops_seconds(arm_file))} more before it, to push every joint onto its stops"
        told += f"; {checked}{drawn}"
        if not reference_mass:
            told += "; the pass begins with a rough gravity model, and may then take other poses, which are checked too"
    print_plan(arm_file, planned, console)
    if picture is not None:
        draw_plan(arm_file, planned, picture)
    console.print(told)
    return {**planned.model_dump(mode="json"), **answer}


def _load(reference_mass: float) -> str:
    return f"with {reference_mass:g} kg attached" if reference_mass else "without a load"


def _minutes(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds >= 90 else f"{seconds:.0f} s"


def _again(arm: str, bus: str | None, hold: str | None, dry_run: bool) -> list[str]:
    """The command for another pass on the same arm and bus, without what differs."""
    given = {"--bus": bus, "--hold": hold}
    options = [word for option, value in given.items() if value is not None for word in (option, value)]
    return ["sweep", arm, *options, *["--dry-run"] * dry_run]


def _show(
    arm_file: "ArmFile", found: "Preflight", data: "SweepData", console: "PlainConsole", again: list[str]
) -> None:
    from armlink.commands.plain_console import command_line, suggest
    from calib.commands.screen import print_lines, print_plan, print_preflight, stall_lines, unsettled_lines

    assert data.plan is not None
    print_preflight(found, console)
    print_plan(arm_file, data.plan, console)
    print_lines([*unsettled_lines(data), *stall_lines(data)], "yellow", console)
    complete = f"{data.path} is complete with {len(data.readings)} readings"
    told, step = next_step(data, again)
    console.print(f"{complete}; {told}")
    suggest(command_line(*step))


def next_step(data: "SweepData", again: list[str]) -> tuple[str, list[str]]:
    """Next step after this pass, as a sentence and as a command in words; `again` is the command of another pass."""
    from calib.dataset import earlier_passes, new_folder

    assert data.plan is not None
    before = [each for each in earlier_passes(data) if each.creeps == data.creeps]
    bare = [each.path for each in before if not each.manifest.reference_mass]

    def another(name: str, *mass: str) -> list[str]:
        return [*again, *mass, "--out", str(new_folder(data.path.with_name(name)))]

    if data.manifest.reference_mass and not bare:
        return "now take the mass off and sweep without it", another("unloaded")
    if data.manifest.reference_mass and data.creeps:
        return "now take the mass off and sweep once more without it", another(f"{bare[-1].name}-again")
    if data.manifest.reference_mass:
        return "now fit both passes", ["calibrate", str(bare[-1]), str(data.path)]
    if data.creeps and bare and before[-1].manifest.reference_mass:
        return "now fit the three passes", ["calibrate", str(bare[-1]), str(before[-1].path), str(data.path)]
    mass = f"{data.plan.reference_mass:g}"
    name = data.path.name
    name = name.replace("unloaded", "loaded") if "unloaded" in name else f"{name}-loaded"
    attach = f"now attach {mass} kg, or less if the arm carries less, away from the last joint's axis, and sweep again"
    return attach, another(name, "--reference-mass", mass)


def _answer(arm_file: "ArmFile", data: "SweepData") -> dict[str, Any]:
    assert data.plan is not None
    return {
        "out": str(data.path),
        "arm": arm_file.name,
        "serial": arm_file.serial,
        "readings": len(data.readings),
        "unsettled": len(data.unsettled),
        "stalls": [stall.model_dump(include={"t", "late_ms", "reading"}) for stall in data.stalls],
        "seconds": data.readings[-1].t,
        "reference_mass": data.manifest.reference_mass,
        "recommended_reference_mass": data.plan.reference_mass,
        "plan": data.plan.model_dump(mode="json"),
    }
