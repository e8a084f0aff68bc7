"""Tables of the record store. A change here needs a migration in `calib/records/migrations/versions`."""

from typing import Any

import sqlalchemy as sa

TABLES = sa.MetaData()


def _texts(*names: str) -> list[sa.Column[str]]:
    return [sa.Column(name, sa.String, nullable=False) for name in names]


def _of_a_record() -> list[sa.Column[Any]]:
    """Columns of a numbered row that is about a record."""
    return [
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("record", sa.String(8), sa.ForeignKey("records.id"), nullable=False),
    ]


def _body() -> sa.Column[str]:
    return sa.Column("body", sa.Text, nullable=False)


RECORDS = sa.Table(
    "records",
    TABLES,
    sa.Column("id", sa.String(8), primary_key=True),
    *_texts("kind", "arm", "serial", "created"),
    _body(),
)
ACTIVATIONS = sa.Table("activations", TABLES, *_of_a_record(), *_texts("kind", "arm", "serial", "at", "by", "reason"))
WRITES = sa.Table("writes", TABLES, *_of_a_record(), *_texts("arm", "serial", "at", "by", "stage"), _body())
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
