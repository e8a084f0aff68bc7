"""alembic's environment: runs the migrations on the connection that `calib.database` gives, in its transaction."""

from alembic import context

from calib.schema import TABLES

context.configure(connection=context.config.attributes["connection"], target_metadata=TABLES, transactional_ddl=True)
context.run_migrations()
