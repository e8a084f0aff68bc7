"""Journal of writes to controllers."""

import sqlalchemy as sa
from alembic import op

from calib.records.database import append_only

revision, down_revision = "0002", "0001"


def upgrade() -> None:
    """One append-only table more; rows of the others stay as they are."""
    op.create_table(
        "writes",
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("record", sa.String(8), sa.ForeignKey("records.id"), nullable=False),
        *(sa.Column(name, sa.String, nullable=False) for name in ("arm", "serial", "at", "by", "stage")),
        sa.Column("body", sa.Text, nullable=False),
    )
    for statement in append_only("writes", op.get_bind().dialect.name):
        op.execute(statement)
