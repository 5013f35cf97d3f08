"""The life of a process with ROS nodes: start, spin, and an end that is quick and quiet."""

from __future__ import annotations

import sys
import threading
import traceback
from typing import Callable, Protocol, Sequence

import rclpy
from rclpy.exceptions import ParameterException, ROSInterruptException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from ..settings import ConfigError
from .signals import StopSignals

FAILED = 1              # exit status where a callback raised
WRONG_USE = 2           # exit status for a wrong setting, as of a wrong command line
_LOOK_UP_S = 0.1        # how often spinning looks whether it was told to stop


class ClosableNode(Protocol):
    """What is asked of a node besides being an rclpy node."""

    def close(self) -> None:
        """End the node's threads; waits for them, but not longer than a second."""

    def destroy_node(self) -> None:
        """As rclpy has it."""


MakeNodes = Callable[[], 'ClosableNode | Sequence[ClosableNode]']


def run(make_nodes: MakeNodes, argv: list[str] | None = None) -> int:
    """Make one node or several, spin them in one thread until a signal; the exit status.

    To be called once, by the main thread, right before the process ends. SIGINT and SIGTERM end
    it; a second one changes nothing. A ConfigError from ``make_nodes`` is one line on stderr and
    status 2; what a callback raises is a traceback there and status 1. A thread that does not end
    in time ends with the process.
    """
    stop = StopSignals()
    threads_before = set(threading.enumerate())
    status = 0
    try:
        status = _live(make_nodes, argv, stop)
    except (ConfigError, ParameterException) as error:
        print(f'error: {error}', file=sys.stderr)
        status = WRONG_USE
    except (KeyboardInterrupt, ExternalShutdownException, ROSInterruptException):
        pass    # told to stop before everything was there, or shut down from outside
    finally:
        stop.end(status)
        rclpy.try_shutdown()
    stop.leave(set(threading.enumerate()) - threads_before, status)
    return status


def _init(argv: list[str] | None) -> None:
    """Raises ConfigError for ROS arguments that cannot be read."""
    try:
        rclpy.init(args=argv, signal_handler_options=SignalHandlerOptions.NO)
    except (RuntimeError, ValueError) as error:     # what rclpy makes of rcl's refusals
        reason = str(error).partition(', at /')[0].partition(' Error: error not set')[0]
        raise ConfigError(f'the ROS arguments cannot be used: {reason}') from error


def _made(make_nodes: MakeNodes) -> ClosableNode | Sequence[ClosableNode]:
    try:
        return make_nodes()
    except RuntimeError as error:
        if 'QoS override' in str(error):    # rclpy has no name for it
            raise ConfigError(f'qos_overrides: {error}') from error
        raise


def _live(make_nodes: MakeNodes, argv: list[str] | None, stop: StopSignals) -> int:
    """The exit status: FAILED where a callback raised, which is said before anything is closed."""
    with stop.interrupting():
        _init(argv)
        made = _made(make_nodes)
    nodes = list(made) if isinstance(made, Sequence) else [made]
    executor = SingleThreadedExecutor()
    status = 0
    try:
        for node in nodes:
            executor.add_node(node)  # type: ignore[arg-type]
        while not stop.told:
            executor.spin_once(timeout_sec=_LOOK_UP_S)
    except (ExternalShutdownException, ROSInterruptException):
        raise
    except Exception:
        status = FAILED
        traceback.print_exc()
    finally:
        stop.end(status)
        for node in nodes:
            node.close()
        executor.shutdown(timeout_sec=0)
        for node in nodes:
            node.destroy_node()
    return status
