from armlink.arm_file import ArmFile as ArmFile
from armlink.arm_file import load_arm as load_arm
from armlink.errors import ArmlinkError as ArmlinkError
from armlink.recording.files import load_recording as load_recording
from armlink.recording.recording import Recording as Recording
from calib.api import calibrate as calibrate
from calib.api import identify as identify
from calib.api import observe as observe
from calib.api import open_link as open_link
from calib.api import sweep as sweep
from calib.api import verify as verify
from sim_gap.api import diagnose as diagnose

__all__ = [
    "ArmFile",
    "ArmlinkError",
    "Recording",
    "calibrate",
    "diagnose",
    "identify",
    "load_arm",
    "load_recording",
    "observe",
    "open_link",
    "sweep",
    "verify",
]
