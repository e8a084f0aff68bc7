"""Emergency messages: names of the error codes of CiA 301 (error classes) and CiA 402-2."""

import struct

_EMCY = struct.Struct("<HB")

CLASSES = {
    0x00: "no error",
    0x10: "generic error",
    0x20: "current",
    0x21: "current, device input side",
    0x22: "current inside the device",
    0x23: "current, device output side",
    0x30: "voltage",
    0x31: "mains voltage",
    0x32: "voltage inside the device",
    0x33: "output voltage",
    0x40: "temperature",
    0x41: "ambient temperature",
    0x42: "device temperature",
    0x43: "drive temperature",
    0x44: "supply temperature",
    0x50: "device hardware",
    0x51: "device hardware: supply",
    0x52: "device hardware: control",
    0x53: "device hardware: operating unit",
    0x54: "device hardware: power section",
    0x55: "device hardware: memory",
    0x60: "device software",
    0x61: "internal software",
    0x62: "user software",
    0x63: "data set",
    0x70: "additional modules",
    0x71: "additional modules: power",
    0x72: "measurement circuit",
    0x73: "sensor",
    0x74: "computation circuit",
    0x75: "additional modules: communication",
    0x76: "external data storage",
    0x80: "monitoring",
    0x81: "communication",
    0x82: "protocol error",
    0x83: "torque control",
    0x84: "velocity controller",
    0x85: "position controller",
    0x86: "positioning controller",
    0x87: "sync controller",
    0x88: "winding controller",
    0x89: "process data monitoring",
    0x8A: "control",
    0x90: "external error",
    0xF0: "additional functions",
    0xFF: "manufacturer specific (torque sensor)",
}
"""High byte of an error code → its class."""


def _phases(base: int, what: str, phases: tuple[str, ...]) -> dict[int, str]:
    """Names for `base` and for each phase or number from base + 1 on."""
    return {base: what, **{base + i: f"{what}, {phase}" for i, phase in enumerate(phases, 1)}}


_MAINS, _MOTOR = ("phase L1", "phase L2", "phase L3"), ("phase U", "phase V", "phase W")
_BETWEEN_MAINS = ("phases L1-L2", "phases L2-L3", "phases L3-L1")
_BETWEEN_MOTOR = ("phases U-V", "phases V-W", "phases W-U")
_NUMBERS = ("no. 1", "no. 2")

NAMES = {
    0x0000: "no error",
    0x1000: "generic error",
    # current
    0x2110: "short circuit or earth leakage at the input",
    **_phases(0x2120, "earth leakage at the input", _MAINS),
    **_phases(0x2130, "short circuit at the input", _BETWEEN_MAINS),
    0x2211: "internal current, no. 1",
    0x2212: "internal current, no. 2",
    0x2213: "over-current in ramp function",
    0x2214: "over-current in the sequence",
    **_phases(0x2220, "continuous over-current inside the device", _NUMBERS),
    0x2230: "short circuit or earth leakage inside the device",
    0x2240: "earth leakage inside the device",
    0x2250: "short circuit inside the device",
    **_phases(0x2310, "continuous over-current", _NUMBERS),
    0x2320: "short circuit or earth leakage at the motor",
    **_phases(0x2330, "earth leakage at the motor", _MOTOR),
    **_phases(0x2340, "short circuit at the motor", _BETWEEN_MOTOR),
    0x2350: "load level fault (I²t, thermal state)",
    0x2351: "load level warning (I²t, thermal state)",
    # voltage
    **_phases(0x3110, "mains over-voltage", _MAINS),
    **_phases(0x3120, "mains under-voltage", _MAINS),
    **_phases(0x3130, "phase failure", _MAINS),
    0x3134: "phase sequence",
    0x3140: "mains frequency",
    0x3141: "mains frequency too high",
    0x3142: "mains frequency too low",
    **_phases(0x3210, "DC link over-voltage", _NUMBERS),
    **_phases(0x3220, "DC link under-voltage", _NUMBERS),
    0x3230: "load error",
    **_phases(0x3310, "output over-voltage", _MOTOR),
    0x3320: "armature circuit",
    0x3321: "armature circuit interrupted",
    0x3330: "field circuit",
    0x3331: "field circuit interrupted",
    # temperature
    0x4110: "ambient temperature too high",
    0x4120: "ambient temperature too low",
    0x4130: "temperature of the supply air",
    0x4140: "temperature of the air outlet",
    0x4210: "device over-temperature",
    0x4220: "device temperature too low",
    0x4310: "drive over-temperature",
    0x4320: "drive temperature too low",
    0x4410: "supply over-temperature",
    0x4420: "supply temperature too low",
    # hardware
    0x5100: "supply",
    0x5110: "supply voltage too low",
    0x5111: "supply ±15 V",
    0x5112: "supply +24 V",
    0x5113: "supply +5 V",
    **{0x5110 + number: f"supply U{number} (manufacturer specific)" for number in range(4, 10)},
    0x5120: "supply of the intermediate circuit",
    0x5200: "control hardware",
    0x5210: "measurement circuit",
    0x5220: "computing circuit",
    0x5300: "operating unit",
    0x5400: "power section",
    0x5410: "output stages",
    0x5420: "chopper",
    0x5430: "input stages",
    0x5440: "contacts",
    **{0x5440 + number: f"contact {number} (manufacturer specific)" for number in range(1, 6)},
    0x5450: "fuses",
    **{0x5450 + number: f"fuse S{number}" for number in range(1, 10)},
    0x5500: "memory",
    0x5510: "RAM",
    0x5520: "ROM or EPROM",
    0x5530: "EEPROM",
    # software
    0x6010: "software reset (watchdog)",
    0x6100: "internal software",
    0x6200: "user software",
    **{0x6300 + number: f"data record no. {number}" for number in range(1, 16)},
    0x6310: "loss of parameters",
    0x6320: "parameter error",
    # additional modules
    0x7100: "power module",
    0x7110: "brake chopper",
    0x7111: "brake chopper failed",
    0x7112: "over-current of the brake chopper",
    0x7113: "protective circuit of the brake chopper",
    0x7120: "motor",
    0x7121: "motor blocked",
    0x7122: "motor error or commutation malfunction",
    0x7123: "motor tilted",
    0x7200: "measurement circuit",
    0x7300: "sensor",
    0x7301: "tacho fault",
    0x7302: "tacho, wrong polarity",
    0x7303: "resolver 1",
    0x7304: "resolver 2",
    0x7305: "incremental sensor",
    0x7306: "incremental sensor 2",
    0x7307: "incremental sensor 3",
    0x7310: "speed",
    0x7320: "position",
    0x7400: "computation circuit",
    0x7500: "communication module",
    0x7510: "serial interface no. 1",
    0x7520: "serial interface no. 2",
    0x7600: "external data storage",
    # monitoring
    0x8110: "CAN overrun (messages lost)",
    0x8120: "CAN error passive",
    0x8130: "heartbeat of the host missing",
    0x8140: "recovered from bus-off",
    0x8150: "CAN-ID collision",
    0x8210: "PDO not processed (length)",
    0x8220: "PDO length exceeded",
    0x8230: "DAM MPDO not processed (no destination object)",
    0x8240: "unexpected SYNC length",
    0x8250: "RPDO deadline missed (no command from the host)",
    0x8300: "torque control",
    0x8311: "torque too high",
    0x8312: "difficult start-up",
    0x8313: "standstill torque",
    0x8321: "torque too low",
    0x8331: "torque fault",
    0x8400: "velocity controller",
    0x8500: "position controller",
    0x8600: "positioning controller",
    0x8611: "following error",
    0x8612: "reference limit",
    0x8700: "sync controller (SYNC missing)",
    0x8800: "winding controller",
    0x8900: "process data monitoring",
    0x8A00: "control",
    # additional functions
    0xF001: "deceleration",
    0xF002: "sub-synchronous run",
    0xF003: "stroke operation",
    0xF004: "control function",
}
"""Codes defined by the standards; other codes of a class are manufacturer-specific."""


def name_of(code: int) -> str:
    """Meaning of an error code; of its class or group if the code itself is not defined."""
    if code in NAMES:
        return NAMES[code]
    high = code >> 8
    return CLASSES.get(high) or CLASSES.get(high & 0xF0, "unknown error")


def parse(data: bytes) -> tuple[int, int]:
    """Error code and error register (1001h) of an EMCY frame; a truncated frame is a generic error."""
    if len(data) < _EMCY.size:
        return 0x1000, 0xFF
    code, register = _EMCY.unpack_from(data)
    return int(code), int(register)
