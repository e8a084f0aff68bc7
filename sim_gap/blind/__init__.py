"""The blind check (contract 6): sealed cases from a plant that the diagnosis does not fit with, and their score."""
