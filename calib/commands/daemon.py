"""Runs the service that watches the arm, keeps its torque sensors true, and serves a page and an API."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from armlink.commands.options import LeRobot, Ros2
from armlink.errors import BadInput
from calib.commands.options import Store

TAKE_OVER_SECONDS = 3.0
"""Time that the bus process of a daemon that was killed may take to leave the joints safe and end [s]."""


def daemon(
    arm: Annotated[str, typer.Argument(help="Name of a bundled arm, or path of an arm file.")],
    bus: Annotated[
        str | None, typer.Option(help="INTERFACE:CHANNEL[@BITRATE]; by default the bus of the arm file.")
    ] = None,
    ros2: Ros2 = None,
    lerobot: LeRobot = None,
    listen_only: Annotated[
        bool,
        typer.Option(
            "--listen-only",
            help="Only listen: another program commands the arm, so the daemon sends no SYNC and no commands. "
            "Exception: an applied recalibration is still written to drives that store their calibration.",
        ),
    ] = False,
    socket: Annotated[
        Path | None,
        typer.Option(
            help="Unix socket of API and page; by default api.sock in the state directory.",
            rich_help_panel="Page and API",
        ),
    ] = None,
    tcp: Annotated[
        str | None, typer.Option(help="Also serve on HOST:PORT; needs --token-file.", rich_help_panel="Page and API")
    ] = None,
    token_file: Annotated[
        Path | None,
        typer.Option(
            help="File with the token that TCP clients must send: at least 16 characters.",
            rich_help_panel="Page and API",
        ),
    ] = None,
    policy: Annotated[
        Literal["observe", "propose", "apply"] | None,
        typer.Option(help="What to do about a drift; overrides daemon.policy of the arm file."),
    ] = None,
    state: Annotated[
        Path | None, typer.Option(help="Directory of journal and recordings; by default the user's state directory.")
    ] = None,
    store: Store = None,
    work: Annotated[
        bool, typer.Option("--work", help="Move the arm to random poses, to try the daemon on a simulated arm.")
    ] = False,
) -> int:
    """Watch an arm for months, until SIGTERM; SIGHUP reads the arm file again, SIGUSR1 requests a sweep.

    Example: armlink daemon sarcos --bus socketcan:can0 --listen-only --policy propose
    """
    from armlink.arm_file import load_arm
    from armlink.bus.open import is_listening, resolve_bus
    from armlink.commands.options import stated_bus
    from armlink.extras import require_extra
    from calib.daemon.logs import log_to_stderr
    from calib.daemon.settings import Options, state_directory
    from calib.records.file_lock import locked_directory

    require_extra("daemon", "daemon")  # they are imported later
    described = load_arm(arm)
    bus = stated_bus(bus, ros2, lerobot)
    opened = resolve_bus(bus, described.require_link().bus)
    listen_only = listen_only or is_listening(opened)
    if opened.interface == "ros2":
        require_extra("daemon --ros2", "ros2")
    directory = state_directory(state, described)
    try:
        directory.mkdir(parents=True, exist_ok=True, mode=0o750)
    except OSError as error:
        raise BadInput(f"--state {directory}: cannot be made: {error.strerror}") from None
    token = _token(token_file)
    address = None if tcp is None else _address(tcp, token)
    options = Options(
        arm=arm,
        socket=socket or directory / "api.sock",
        bus=bus,
        listen_only=listen_only,
        tcp=address,
        token=token,
        policy=policy,
        store=store,
        work=work,
    )
    log_to_stderr()
    with locked_directory(directory, f"--state {directory}", patience=TAKE_OVER_SECONDS) as lock:
        kept = options.keep(described, lock)  # which holds the lock until it has left the joints safe
        from calib.daemon.main_loop import run_daemon  # takes long to load: the bus is opened meanwhile

        run_daemon(options, described, directory, kept)
    return 0


def _token(path: Path | None) -> str | None:
    if path is None:
        return None
    try:
        token = path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise BadInput(f"--token-file {path}: cannot be read: {error}") from None
    if not token:
        raise BadInput(f"--token-file {path}: the file is empty; expected one line with the token")
    return token


def _address(text: str, token: str | None) -> tuple[str, int]:
    host, colon, port = text.rpartition(":")
    if not (colon and host and port.isdigit() and 0 < int(port) < 65536):
        raise BadInput(f"--tcp {text}: expected HOST:PORT, for example 127.0.0.1:8080")
    if token is None:
        raise BadInput("--tcp needs --token-file, since whoever has the token may decide on proposals")
    return host.strip("[]"), int(port)
