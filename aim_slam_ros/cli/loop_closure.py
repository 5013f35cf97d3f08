"""The loop-closure node as a process."""

from __future__ import annotations

import sys

from aim_slam_ros.nodes.running import ClosableNode, run


def main(argv: list[str] | None = None) -> int:
    """Exit status: 0 ended by a signal, 2 a parameter was refused."""
    return run(_node, argv)


def _node() -> ClosableNode:
    # torch takes seconds to import: `run` is ready for Ctrl-C by then.
    from aim_slam_ros.nodes.loop_closure_node import LoopClosureNode
    return LoopClosureNode()


if __name__ == '__main__':
    sys.exit(main())
