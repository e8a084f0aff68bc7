"""The daemon's API and page: reads through `calib.daemon.view.view.DaemonView`, commands nothing."""
