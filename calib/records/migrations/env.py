"""Alembic environment: runs migrations on the connection of `calib.records.database`, in its transaction."""

from alembic import context

from calib.records.database import TABLES

context.configure(connection=context.config.attributes["connection"], target_metadata=TABLES, transactional_ddl=True)
context.run_migrations()
