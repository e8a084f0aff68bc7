"""The ODrive family, as the registry finds it."""

from armlink.drives.family import Family
from armlink.drives.odrive.drives import TRAITS, ODriveDrives, ODriveSettings

FAMILY = Family(
    "odrive", TRAITS, ODriveSettings, ODriveDrives, summary="ODrive Pro, S1, Micro with firmware 0.6, CANSimple"
)
