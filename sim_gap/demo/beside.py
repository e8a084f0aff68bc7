"""Work on another core, while this one goes on."""

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import ParamSpec, TypeVar

Given = ParamSpec("Given")
Made = TypeVar("Made")


@contextmanager
def beside(work: Callable[Given, Made], *given: Given.args, **options: Given.kwargs) -> Iterator[Callable[[], Made]]:
    """A call that returns what `work`, a module's function, makes of what is given, or raises as it does.

    A process of its own works from now on, where there is a core for it; else the work is done in the call. It ends
    with the context: where this process gives up, nobody waits for the other.
    """
    whole = partial(work, *given, **options)
    if len(os.sched_getaffinity(0)) < 2:
        yield whole
        return
    context = get_context("spawn")
    end, far = context.Pipe(duplex=False)
    worker = context.Process(target=_answer, args=(far, whole), daemon=True)
    worker.start()
    far.close()  # so that an end of the worker without an answer is heard here

    def answer() -> Made:
        try:
            made, error = end.recv()
        except EOFError:
            worker.join()
            raise RuntimeError(f"the process beside this one ended without an answer: {worker.exitcode}") from None
        if error is not None:
            raise error
        return made  # type: ignore[no-any-return]

    try:
        yield answer
    finally:
        worker.terminate()
        worker.join()
        end.close()


def _answer(end: Connection, work: Callable[[], object]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the other process's, which then ends this one
    try:
        end.send((work(), None))
    except Exception as error:
        end.send((None, error))
