"""Schema migrations of the record store, run by alembic when a store is opened (`calib.database`)."""
