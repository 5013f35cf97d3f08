"""Frontend and loop closure in one process: one model, loaded once."""

from __future__ import annotations

import sys

from ..models.shared import SharedModel
from .frontend_node import FrontendNode
from .loop_closure_node import LoopClosureNode
from .running import ClosableNode, run


def make_nodes() -> list[ClosableNode]:
    """Both nodes; the model is that of the frontend's parameters."""
    frontend = FrontendNode(SharedModel)
    return [frontend, LoopClosureNode(frontend.model)]


def main(argv: list[str] | None = None) -> int:
    """The executable ``slam``."""
    return run(make_nodes, argv)


if __name__ == '__main__':
    sys.exit(main())
