"""Emergency messages: error codes (CiA 301 table 26, CiA 402) to names."""

import struct

_EMCY = struct.Struct("<HB")

NAMES = {
    0x0000: "no error",
    0x1000: "generic error",
    0x2310: "continuous over-current",
    0x3210: "DC link over-voltage",
    0x3220: "DC link under-voltage",
    0x4210: "drive over-temperature",
    0x4310: "motor over-temperature",
    0x5441: "emergency stop contact",
    0x6100: "internal software",
    0x6320: "parameter error",
    0x7121: "motor blocked",
    0x7300: "sensor",
    0x7305: "incremental sensor",
    0x7310: "speed",
    0x7320: "position",
    0x8110: "CAN overrun (messages lost)",
    0x8120: "CAN error passive",
    0x8130: "heartbeat of the host missing",
    0x8140: "recovered from bus-off",
    0x8150: "CAN-ID collision",
    0x8210: "PDO not processed (length)",
    0x8250: "RPDO deadline missed (no command from the host)",
    0x8300: "torque control",
    0x8311: "torque too high",
    0x8331: "torque fault",
    0x8611: "following error",
}
_GROUPS = {
    0x1: "generic error",
    0x2: "current",
    0x3: "voltage",
    0x4: "temperature",
    0x5: "hardware",
    0x6: "software",
    0x7: "additional modules",
    0x8: "monitoring",
    0x9: "external error",
    0xF: "additional functions",
}


def name_of(code: int) -> str:
    """What an error code means; by its group where the code itself is unknown."""
    if code in NAMES:
        return NAMES[code]
    if code & 0xFF00 == 0xFF00:
        return "manufacturer specific (torque sensor)"
    return _GROUPS.get(code >> 12, "unknown error")


def parse(data: bytes) -> tuple[int, int]:
    """Error code and error register (1001h) of an EMCY frame; a frame that is too short is a generic error."""
    if len(data) < _EMCY.size:
        return 0x1000, 0xFF
    code, register = _EMCY.unpack_from(data)
    return int(code), int(register)
