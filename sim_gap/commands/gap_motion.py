"""Plans the motion that would separate the candidate causes of a diagnosis, and runs it on the arm."""

from pathlib import Path
from typing import Annotated

import typer

from armlink.commands.options import Arm, Json, OtherBus
from armlink.commands.output import write_json
from armlink.errors import BadInput


def plan(
    arm: Arm,
    out: Annotated[Path, typer.Option(help="Write the motion to this file (.csv with columns t and q_cmd_i).")],
    answer: Annotated[
        Path | None, typer.Option(help="Result of gap diagnose --json; the joints whose cause is undecided are moved.")
    ] = None,
    joint: Annotated[
        list[str] | None, typer.Option(help="Joint to move alone; may be repeated. By default every joint.")
    ] = None,
    poses: Annotated[
        int, typer.Option(min=1, help="Number of poses of the other joints, which give different loads.")
    ] = 2,
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of poses and sines; another seed gives a held-out motion.")
    ] = 0,
    json: Json = None,
) -> int:
    """Plan motion within the arm's limits that separates effects; nothing moves.

    Example: armlink gap plan sarcos --answer gap.json --out settle.csv
    """
    from armlink.arm_file import load_arm
    from armlink.commands.plain_console import command_line, results, suggest
    from sim_gap.experiment import joints_in_doubt, plan_motion, save_motion

    joints, sentences = joints_in_doubt(answer) if answer else ([], [])
    motion = plan_motion(load_arm(arm), [*joints, *(joint or [])], poses, seed)
    save_motion(motion, out)
    console = results(json)
    for sentence in sentences:
        console.print(f"the diagnosis asks for this motion: {sentence}")
    for piece in motion.pieces:
        console.print(piece)
    console.print(f"{out}: {motion.seconds:.0f} s of motion")
    suggest(command_line("gap", "collect", arm, motion=out, out=out.with_suffix(".mcap")))
    write_json(json, {"file": str(out), "seconds": motion.seconds, "pieces": motion.pieces, "asked_for": sentences})
    return 0


def collect(
    arm: Arm,
    motion: Annotated[Path, typer.Option(help="Motion with columns t and q_cmd_i, as gap plan writes it.")],
    out: Annotated[Path, typer.Option(help="Recording to write (.mcap).")],
    bus: OtherBus = None,
    json: Json = None,
) -> int:
    """Move the arm along a planned motion under position control and record every cycle; Ctrl-C stops it safely.

    Example: armlink gap collect sarcos --motion settle.csv --out settle.mcap --bus socketcan:can0
    """
    from rich.progress import Progress

    from armlink.arm_file import load_arm
    from armlink.commands.early_end import early_end
    from armlink.commands.plain_console import PlainColumn, PlainConsole, command_line, results, suggest
    from armlink.extras import require_extra
    from armlink.loop.open import open_arm
    from sim_gap.experiment import collect as run
    from sim_gap.experiment import load_motion

    if out.suffix != ".mcap" or not out.resolve().parent.is_dir():
        raise BadInput(f"--out {out}: give a name that ends in .mcap, in a folder that exists")
    require_extra(f"--out {out}", "bags")
    arm_file = load_arm(arm)
    target = load_motion(motion, arm_file)
    console = PlainConsole()
    again = command_line("gap", "collect", arm, motion=motion, out=out, bus=bus)
    with (
        early_end(arm_file, again) as work,
        open_arm(arm_file, bus) as link,
        Progress(PlainColumn("{task.description}"), *Progress.get_default_columns()[1:], console=console) as bars,
    ):
        task = bars.add_task(f"{arm_file.name}: {motion.name}", total=len(target))
        link.start()
        work.enabled = True
        link.enable()
        rows = run(link, target, out, lambda k, _: bars.update(task, completed=k) if k % 50 == 0 else None)
        bars.update(task, completed=rows)
        link.disable()
    results(json).print(f"{out}: {rows} rows, {rows / link.rate:.1f} s")
    suggest(command_line("gap", "diagnose", sim=arm, train=out))
    write_json(json, {"file": str(out), "rows": rows, "seconds": rows / link.rate})
    return 0
