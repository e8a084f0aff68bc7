"""The demo: the whole job on a simulated arm, with its hidden truth laid open only at the end."""
