"""A mutant put into modules that are loaded already: the code of its function is exchanged, so that nothing loads anew.

A mutant outside of functions (a constant, a default, a decorator, a class body) cannot be put in this way.
"""

import ast
import gc
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FunctionType


def functions(code: CodeType) -> Iterator[CodeType]:
    """Functions and methods of a module, in their order; not those inside of functions."""
    for each in code.co_consts:
        if isinstance(each, CodeType):
            if each.co_flags & 0x2:  # CO_NEWLOCALS: a function, not the body of a class
                yield each
            else:
                yield from functions(each)


def bodies(code: CodeType) -> list[object]:
    """What a module and its classes do when they are loaded."""
    inner = [each for each in code.co_consts if isinstance(each, CodeType) and not each.co_flags & 0x2]
    own = [each for each in code.co_consts if not isinstance(each, CodeType)]
    return [code.co_code, [(type(each), each) for each in own], code.co_names, *map(bodies, inner)]


def changed(path: Path, source: str) -> list[tuple[str, int, int, CodeType]] | None:
    """Functions that differ in a mutant: name, place among those of this name, how many have it, code.

    None if more than functions differ.
    """
    before = compile(ast.unparse(ast.parse(path.read_text(encoding="utf-8"))), str(path), "exec", dont_inherit=True)
    after = compile(source, str(path), "exec", dont_inherit=True)
    ours, theirs = list(functions(before)), list(functions(after))
    if bodies(before) != bodies(after) or [f.co_qualname for f in ours] != [f.co_qualname for f in theirs]:
        return None
    found, seen, count = [], Counter[str](), Counter(each.co_qualname for each in ours)
    for old, new in zip(ours, theirs, strict=True):
        if old != new:
            found.append((new.co_qualname, seen[new.co_qualname], count[new.co_qualname], new))
        seen[new.co_qualname] += 1
    return found


class Live:
    """The functions that are loaded. Made once, before forks: looking at every object copies their memory."""

    def __init__(self) -> None:
        self._by_file: dict[str, dict[str, list[FunctionType]]] = defaultdict(lambda: defaultdict(list))
        for each in gc.get_objects():
            if type(each) is FunctionType:
                self._by_file[each.__code__.co_filename][each.__code__.co_qualname].append(each)
        gc.freeze()

    def patch(self, path: Path, source: str, only_ask: bool = False) -> bool:
        """Exchange the code of what a mutant changes; whether that is possible, else nothing is changed."""
        exchanges = []
        for name, place, count, code in changed(path, source) or ():
            live = self._by_file[str(path)][name]
            lines = sorted({each.__code__.co_firstlineno for each in live})
            if len(lines) != count:  # some are gone, or on one line
                return False
            targets = [each for each in live if each.__code__.co_firstlineno == lines[place]]
            if any(each.__code__.co_freevars != code.co_freevars for each in targets):
                return False
            exchanges += [(each, code) for each in targets]
        for target, code in () if only_ask else exchanges:
            target.__code__ = code
        return bool(exchanges)
