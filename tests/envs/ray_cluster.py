"""A Ray cluster of several nodes, which are processes of this machine, for tests. All traffic is on the loopback address."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

LOOPBACK = {"node_ip_address": "127.0.0.1", "include_dashboard": False}


@contextmanager
def running(n_nodes: int = 2, num_cpus: int = 8) -> Iterator[tuple[Any, list[Any]]]:
    """Starts a head that runs nothing and nodes with so many (imaginary) CPUs each; stops everything on exit."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={**LOOPBACK, "num_cpus": 0})
    try:
        yield cluster, [cluster.add_node(**LOOPBACK, num_cpus=num_cpus) for _ in range(n_nodes)]
    finally:
        sys.modules["ray"].shutdown()
        cluster.shutdown()
