"""Connections to PostgreSQL that are given up where the server answers nothing.

A server that hangs (stopped, or waiting for its disk) has a kernel that goes on to acknowledge what is sent, so that
neither TCP's time-outs nor the server's own `statement_timeout` end the wait: the host has to.
"""

import os
import socket
import threading
from contextlib import suppress
from typing import Any

import psycopg
import sqlalchemy as sa


class ImpatientConnection(psycopg.Connection[Any]):
    """Raises psycopg.OperationalError, and is of no more use, where the server does not answer in time."""

    patience: float
    """Longest wait for an answer [s]."""

    def wait(self, *given: Any, **options: Any) -> Any:
        """As psycopg's, with an end; all that asks the server goes through here, connecting apart."""
        seconds, silent = self.patience, threading.Event()

        def hang_up() -> None:
            silent.set()
            with suppress(OSError), socket.socket(fileno=os.dup(self.pgconn.socket)) as wire:
                wire.shutdown(socket.SHUT_RDWR)

        timer = threading.Timer(seconds, hang_up)
        timer.daemon = True
        timer.start()
        try:
            return super().wait(*given, **options)
        except psycopg.OperationalError:
            if silent.is_set():
                raise psycopg.OperationalError(f"the server has not answered for {seconds:g} s") from None
            raise
        finally:
            timer.cancel()


def give_up_when_silent(engine: sa.Engine, seconds: float) -> None:
    """Let an engine for PostgreSQL make connections of this kind."""

    @sa.event.listens_for(engine, "do_connect")
    def _connect(_dialect: object, _record: object, given: Any, options: Any) -> ImpatientConnection:
        connection = ImpatientConnection.connect(*given, **options)
        connection.patience = seconds
        return connection
