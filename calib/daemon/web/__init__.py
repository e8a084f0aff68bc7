"""The daemon's API and page: read through `calib.daemon.view.view.DaemonView`, command nothing."""
