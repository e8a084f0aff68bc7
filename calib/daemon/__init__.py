"""The long-running service: bus loop, observer, records of what happened; `calib.daemon.web` shows it."""
