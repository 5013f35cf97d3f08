"""ROS domains of this machine."""

from __future__ import annotations

import os
import random
import socket

# From 102 on the ports of a domain are those that the system gives to outgoing connections.
_DOMAINS = range(1, 102)
# DDS: domain d has the ports from 7400 + 250 d on; +0 is shared by all of its participants on a
# network, each takes two of its own from +10 on.
_FIRST_PORT, _PORTS_PER_DOMAIN = 7400, 250
_OFFSETS = (0, *range(10, 40, 2))


class NoFreeDomain(RuntimeError):
    """Every domain is in use."""


def free_domain() -> int:
    """A ROS_DOMAIN_ID in which nobody on this machine takes part; raises NoFreeDomain.

    A random one, so that two who look at the same time hardly find the same.
    """
    for domain in random.Random(os.getpid()).sample(_DOMAINS, len(_DOMAINS)):
        if all(_is_free(_FIRST_PORT + _PORTS_PER_DOMAIN * domain + n) for n in _OFFSETS):
            return domain
    raise NoFreeDomain(f'ROS domains {_DOMAINS[0]} to {_DOMAINS[-1]} are all in use on this '
                       'machine; end other ROS programs')


def _is_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(('', port))
        except OSError:
            return False
    return True
