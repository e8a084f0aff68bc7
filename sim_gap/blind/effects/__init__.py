"""The blind form of the effects: magnitudes that show in a recording, put into the true arm."""
