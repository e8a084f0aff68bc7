"""Effects of contract 4 as the blind check draws them: forward form, and magnitudes that show in the recording."""
