"""The wire: CAN frames to samples in SI units and limited commands back; arm file and recordings."""
