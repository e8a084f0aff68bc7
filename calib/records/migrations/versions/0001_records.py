"""Records and the log of which was current when."""

import sqlalchemy as sa
from alembic import op

from calib.records.database import append_only

revision, down_revision = "0001", None


def upgrade() -> None:
    """Two append-only tables."""
    op.create_table(
        "records",
        sa.Column("id", sa.String(8), primary_key=True),
        *(sa.Column(name, sa.String, nullable=False) for name in ("kind", "arm", "serial", "created")),
        sa.Column("body", sa.Text, nullable=False),
    )
    op.create_table(
        "activations",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("record", sa.String(8), sa.ForeignKey("records.id"), nullable=False),
        *(sa.Column(name, sa.String, nullable=False) for name in ("kind", "arm", "serial", "at", "by", "reason")),
    )
    for table in ("records", "activations"):
        for statement in append_only(table, op.get_bind().dialect.name):
            op.execute(statement)
