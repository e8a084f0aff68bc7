"""Tables of the record store. A change here needs a migration in `calib/records/migrations/versions`."""

import sqlalchemy as sa

TABLES = sa.MetaData()
RECORDS = sa.Table(
    "records",
    TABLES,
    sa.Column("id", sa.String(8), primary_key=True),
    sa.Column("kind", sa.String, nullable=False),
    sa.Column("arm", sa.String, nullable=False),
    sa.Column("serial", sa.String, nullable=False),
    sa.Column("created", sa.String, nullable=False),
    sa.Column("body", sa.Text, nullable=False),
)
ACTIVATIONS = sa.Table(
    "activations",
    TABLES,
    sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
    sa.Column("record", sa.String(8), sa.ForeignKey("records.id"), nullable=False),
    sa.Column("kind", sa.String, nullable=False),
    sa.Column("arm", sa.String, nullable=False),
    sa.Column("serial", sa.String, nullable=False),
    sa.Column("at", sa.String, nullable=False),
    sa.Column("by", sa.String, nullable=False),
    sa.Column("reason", sa.String, nullable=False),
)
WRITES = sa.Table(
    "writes",
    TABLES,
    sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
    sa.Column("record", sa.String(8), sa.ForeignKey("records.id"), nullable=False),
    sa.Column("arm", sa.String, nullable=False),
    sa.Column("serial", sa.String, nullable=False),
    sa.Column("at", sa.String, nullable=False),
    sa.Column("by", sa.String, nullable=False),
    sa.Column("stage", sa.String, nullable=False),
    sa.Column("body", sa.Text, nullable=False),
)
"""Journal of writes to controllers: stage `begun` with the calibrations held before, then `finished` or `undone`."""

MIGRATIONS = ("0001", "0002")
"""Revisions of the schema, oldest first; the last one makes the tables above."""


def append_only(table: str, dialect: str) -> list[str]:
    """Statements that make the database itself refuse to change or delete rows of a table."""
    if dialect == "sqlite":
        return [
            f"CREATE TRIGGER IF NOT EXISTS {table}_no_{change.lower()} BEFORE {change} ON {table} "
            f"BEGIN SELECT RAISE(ABORT, '{table} is append-only'); END"
            for change in ("UPDATE", "DELETE")
        ]
    if dialect == "postgresql":
        refuse = f"{table}_append_only"
        return [
            f"CREATE OR REPLACE FUNCTION {refuse}() RETURNS trigger LANGUAGE plpgsql AS "
            f"$$ BEGIN RAISE EXCEPTION '{table} is append-only'; END $$",
            f"CREATE TRIGGER {refuse} BEFORE UPDATE OR DELETE ON {table} FOR EACH ROW EXECUTE FUNCTION {refuse}()",
            f"CREATE TRIGGER {refuse}_all BEFORE TRUNCATE ON {table} FOR EACH STATEMENT EXECUTE FUNCTION {refuse}()",
        ]
    return []
