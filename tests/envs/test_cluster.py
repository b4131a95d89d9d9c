"""Connections to Ray clusters: addresses and versions."""

import socket
import sys

import pytest

from rejeu.core.errors import ClusterError, MissingExtra
from rejeu.envs.workers import cluster


def test_without_ray_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtra, match=r"backend='ray' needs ray, .* pip install \"rejeu\[ray\]\""):
        cluster.connect()


@pytest.mark.parametrize("address", ["here", "host:", ":1", "host:x", "host:0", "host:99999"])
def test_other_addresses_are_refused(address):
    with pytest.raises(ValueError, match=r"expected HOST:PORT such as .*, or 'auto'"):
        cluster.check_reachable(address)


def test_a_client_address_is_refused():
    with pytest.raises(ValueError, match="is that of a client; run on a machine of the cluster"):
        cluster.check_reachable("ray://10.0.0.1:10001")


def test_a_cluster_that_does_not_answer_is_one_line():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        cluster.check_reachable(f"127.0.0.1:{port}")
    with pytest.raises(
        ClusterError, match=rf"^the Ray cluster '127.0.0.1:{port}' cannot be reached: .*ray start --head"
    ):
        cluster.check_reachable(f"127.0.0.1:{port}")


def test_versions_of_other_machines_are_compared():
    here = cluster.versions()
    cluster.check_versions(here, "node 1")
    with pytest.raises(ClusterError, match=rf"^node 1 has gymnasium 0\.1 and not {here['gymnasium']} as here; install"):
        cluster.check_versions({**here, "gymnasium": "0.1"}, "node 1")
    with pytest.raises(ClusterError, match="numpy of no version"):
        cluster.check_versions({key: value for key, value in here.items() if key != "numpy"}, "node 1")
