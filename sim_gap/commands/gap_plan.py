"""Plans the motion that would separate the candidate causes of a diagnosis."""

from pathlib import Path
from typing import Annotated

import typer

from armlink.commands.options import Arm


def plan(
    arm: Arm,
    out: Annotated[Path, typer.Option(help="Write the motion here (.csv with t and q_cmd_i).")],
    answer: Annotated[
        Path | None, typer.Option(help="Result of gap diagnose --json: its undecided joints are moved.")
    ] = None,
    joint: Annotated[list[str] | None, typer.Option(help="Joint to move alone; may be repeated. Default: all.")] = None,
    poses: Annotated[int, typer.Option(min=1, help="Number of poses of the other joints, for different loads.")] = 2,
    seed: Annotated[int, typer.Option(min=0, help="Seed of poses and sines; another one gives held-out motion.")] = 0,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write length and pieces here; - is standard output.")
    ] = None,
) -> int:
    """Plan motion within the arm's limits that separates effects; nothing moves.

    Example: armlink gap plan sarcos --answer gap.json --out settle.csv
    """
    from armlink.arm_file import load_arm
    from armlink.commands.output import write_json
    from armlink.commands.plain_console import command_line, results, suggest
    from sim_gap.experiment.excitation import joints_in_doubt, plan_motion
    from sim_gap.experiment.motion_file import save_motion

    joints, sentences = joints_in_doubt(answer) if answer else ([], [])
    motion = plan_motion(load_arm(arm), [*joints, *(joint or [])], poses, seed)
    save_motion(motion, out)
    console = results(json_file)
    for sentence in sentences:
        console.print(f"requested by the diagnosis: {sentence}")
    for piece in motion.pieces:
        console.print(piece)
    console.print(f"{out}: {motion.seconds:.0f} s of motion")
    suggest(command_line("gap", "collect", arm, motion=out, out=out.with_suffix(".mcap")))
    write_json(
        json_file,
        {"file": str(out), "seconds": motion.seconds, "pieces": list(motion.pieces), "asked_for": sentences},
    )
    return 0
