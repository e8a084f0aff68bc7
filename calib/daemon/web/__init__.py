"""The daemon's API and page: reads through `calib.daemon.view.DaemonView`, commands nothing."""
