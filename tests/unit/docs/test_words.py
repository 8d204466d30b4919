"""Names of values in the core say what a value is; the vague ones that are left only get fewer."""

import ast
from collections import Counter
from itertools import chain

from tests.unit.docs.test_extras import is_extra
from tests.unit.docs.test_imports import modules

VAGUE = {
    *("asked", "found", "given", "here", "known", "made", "one", "place", "said", "there", "told"),
    *("what", "where", "which", "whole"),
}
MOST = 75


def bound_names(module: ast.Module) -> list[str]:
    nodes = list(ast.walk(module))
    stored = (n.id for n in nodes if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store))
    return [*stored, *(node.arg for node in nodes if isinstance(node, ast.arg))]


def test_vague_names_only_get_fewer() -> None:
    """Name a value for what it is: a frame, a request, a path. Lower ``MOST`` with the number."""
    core = [bound_names(module) for name, module in modules().items() if not is_extra(name)]
    vague = Counter(name for name in chain.from_iterable(core) if name in VAGUE)
    assert vague.total() <= MOST, vague.most_common()
