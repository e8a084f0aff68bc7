"""The RobStride family, as the registry finds it."""

from armlink.drives.family import Family
from armlink.drives.robstride.drives import TRAITS, RobStrideDrives
from armlink.drives.robstride.settings import RobStrideSettings

FAMILY = Family(
    "robstride",
    TRAITS,
    RobStrideSettings,
    RobStrideDrives,
    summary="RobStride RS00 to RS06 (reBot B601-RS), private protocol",
)
