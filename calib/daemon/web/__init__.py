"""The daemon's API and page: read through `calib.daemon.view.DaemonView`, command nothing."""
