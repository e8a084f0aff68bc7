"""Runs a simulated arm on a CAN bus, in real time, until stopped."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from armlink.arm_file import ArmFile


def sim(
    arm: Annotated[str, typer.Argument(help="Bundled arm, or path of an arm file with the key sim.")],
    bus: Annotated[str, typer.Option(help="INTERFACE:CHANNEL[@BITRATE]; by default the bus of the arm file.")] = "",
    effect: Annotated[
        list[str] | None,
        typer.Option(help="ID:JOINT:VALUE[,VALUE…] or ID:JOINT:NAME=VALUE[,…]; ID::VALUE for all joints, or the arm."),
    ] = None,
    drift: Annotated[
        list[str] | None,
        typer.Option(
            help="JOINT:GAIN:OFFSET@T: from T s on the torque sensor drifts, by a factor and by an offset in N·m."
        ),
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(help="ID:JOINT[:VALUE][@T] or ID::VALUE[@T]: a fault from T s on (see docs/faults.md)."),
    ] = None,
    control: Annotated[
        Path | None,
        typer.Option(
            help="Named pipe to create for commands: 'mass 1.9', 'effect friction.coulomb:joint_2:1', 'fault …'."
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(help="Seed from which the true sensor parameters are drawn; by default the arm file gives them."),
    ] = None,
    realism: Annotated[
        float | None,
        typer.Option(
            min=0, help="Size of the small imperfections of a real arm, drawn from --seed: 1 a good arm, 3 a bad arm."
        ),
    ] = None,
    lockstep: Annotated[
        bool, typer.Option(help="Each SYNC advances the physics by one period, independent of real time.")
    ] = False,
) -> int:
    """Run a simulated arm on a CAN bus until SIGINT or SIGTERM.

    Example: armlink sim sarcos --bus socketcan:vcan0 --effect friction.coulomb:joint_2:1.5 --seed 1 --control arm.pipe
    Then, from another shell: echo "mass 1.9" > arm.pipe, which hangs the reference mass on the flange ("mass 0" takes
    it off), or echo "fault node.silent:joint_2" > arm.pipe
    """
    import mujoco

    from armlink.arm_file import load_arm
    from armlink.bus.open import open_link_bus, resolve_bus
    from armlink.commands.plain_console import PlainConsole
    from armlink.errors import BadInput
    from armlink.loop.realtime import SIMULATED_PRIORITY, prepare
    from sim_bus.bus.control_pipe import ControlPipe
    from sim_bus.bus.effect_options import parse_drift, parse_effect
    from sim_bus.bus.fault_kinds import parse_fault
    from sim_bus.bus.server import ArmServer
    from sim_bus.sim_section import with_realism
    from sim_bus.simulated_arm import SimulatedArm
    from sim_bus.truth import Truth

    # MuJoCo reads the time about twenty times a step for its profiler, which is not used here. In a user-mode kernel
    # each is a system call and made a step forty times as long.
    mujoco.set_mjcb_time(lambda: 0.0)
    described = load_arm(arm)
    if realism is not None:
        described = with_realism(described, realism, seed or 0)
    entries = [each for text in effect or () for each in parse_effect(text, described.joint_names)]
    drifts = [parse_drift(text, described.joint_names) for text in drift or ()]
    faults = [parse_fault(text, described.joint_names) for text in fault or ()]
    truth = Truth.of(described) if seed is None else Truth.draw(described, seed)
    simulated = SimulatedArm(described, truth, seed or 0)
    simulated.set_effects([*simulated.effects, *entries])
    if resolve_bus(bus or None, described.require_link().bus).interface == "armlink_sim":
        raise BadInput(
            "sim: bus armlink_sim is itself a simulated arm: choose another bus, for example --bus socketcan:vcan0"
        )
    endpoint = open_link_bus(bus or None, described.require_link())
    if not lockstep:
        prepare(SIMULATED_PRIORITY)
    pipe = None
    try:
        pipe = None if control is None else ControlPipe(control)
        console = PlainConsole()
        console.print(
            f"{described.name}: {simulated.n} joints, {_addresses(described)} on {endpoint.channel_info}; "
            f"stop with Ctrl-C"
        )
        server = ArmServer(simulated, endpoint, drifts, lockstep, faults=faults, control=pipe)
        server.on_command = lambda answer: console.print(f"sim: {answer}")
        deadline = described.require_link().deadline
        server.on_late = lambda lag, at: console.print(
            f"sim: at {at:.1f} s this process was {1000 * lag:.0f} ms late, and so were its readings (from "
            f"{1000 * deadline:.0f} ms on a host reports silent drives)"
        )
        return server.run()
    finally:
        if pipe is not None:
            pipe.close()
        endpoint.shutdown()


def _addresses(arm: "ArmFile") -> str:
    """Ids of the drives: `nodes 1, 2`, or each with its word where they differ."""
    parts = [joint.settings.address.rpartition(" ") for joint in arm.require_link().joints]
    words = {word for word, _, _ in parts}
    if len(words) == 1:
        return f"{words.pop()}s {', '.join(number for _, _, number in parts)}"
    return ", ".join("".join(part) for part in parts)
