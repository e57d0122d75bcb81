"""Network namespaces for the processes of a team.

All hang on a bridge in the router's namespace, apart from this machine's network. Needs root and
`ip` (Linux).
"""

import os
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

NET = "10.213.77"
HOSTS = Path("/etc/netns")  # `ip netns exec` lays the files of HOSTS/NAMESPACE over those in /etc


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True)


@contextmanager
def network(nodes: Sequence[str]) -> Iterator[dict[str, str]]:
    """Make a namespace with a bridge for the router and one per node; yield the names.

    The names resolve in each. Raises subprocess.CalledProcessError where namespaces are not
    permitted.
    """
    names = {node: f"teamslam-{os.getpid()}-{k}" for k, node in enumerate(["router", *nodes])}
    hosts = "".join(f"{NET}.{k} {node}\n" for k, node in enumerate(names, 1))
    had_hosts = HOSTS.exists()
    made: list[str] = []
    try:
        for name in names.values():
            ip("netns", "add", name)
            made.append(name)
            ip("-n", name, "link", "set", "lo", "up")
            (HOSTS / name).mkdir(parents=True)
            (HOSTS / name / "hosts").write_text(f"127.0.0.1 localhost\n{hosts}")
        hub = names["router"]
        ip("-n", hub, "link", "add", "hub", "type", "bridge")
        ip("-n", hub, "addr", "add", f"{NET}.1/24", "dev", "hub")
        ip("-n", hub, "link", "set", "hub", "up")
        for k, node in enumerate(nodes):
            of = names[node]
            ip("-n", hub, "link", "add", node, "type", "veth", "peer", "name", "up0", "netns", of)
            ip("-n", hub, "link", "set", node, "master", "hub", "up")
            ip("-n", of, "addr", "add", f"{NET}.{k + 2}/24", "dev", "up0")
            ip("-n", of, "link", "set", "up0", "up")
        yield names
    finally:
        for name in made:
            ip("netns", "del", name)
            shutil.rmtree(HOSTS / name, ignore_errors=True)
        if not had_hosts and HOSTS.exists() and not any(HOSTS.iterdir()):
            HOSTS.rmdir()
