"""Frontend and loop closure in one process that share one model."""

from __future__ import annotations

import sys

from aim_slam_ros.nodes.running import ClosableNode, run


def main(argv: list[str] | None = None) -> int:
    """Exit status: 0 ended by a signal, 2 a parameter was refused."""
    return run(_nodes, argv)


def _nodes() -> list[ClosableNode]:
    # torch takes seconds to import: `run` is ready for Ctrl-C by then.
    from aim_slam_ros.models.shared import SharedModel
    from aim_slam_ros.nodes.frontend_node import FrontendNode
    from aim_slam_ros.nodes.loop_closure_node import LoopClosureNode
    frontend = FrontendNode(SharedModel)
    return [frontend, LoopClosureNode(frontend.model)]


if __name__ == '__main__':
    sys.exit(main())
