"""Say who reaches whom, by the table of services: ``python deploy/kubernetes/policies.py >…/base/network.yaml``.

Whatever has a role goes to the routers, and to nobody else; nobody is reached but they. What each may say there its
certificate says (`services/kit/access.py`). A pod without a role of the table reaches nothing.
"""

import yaml

from services.kit.bus import DEFAULT_ROUTER, host_and_port
from services.table import roles

Policy = dict[str, object]
ROUTER = {"podSelector": {"matchLabels": {"role": "router"}}}
BUS = [{"port": host_and_port(DEFAULT_ROUTER)[1]}]
NAMES: Policy = {
    "to": [
        {
            "namespaceSelector": {"matchLabels": {"kubernetes.io/metadata.name": "kube-system"}},
            "podSelector": {"matchLabels": {"k8s-app": "kube-dns"}},
        }
    ],
    "ports": [{"port": 53, "protocol": "UDP"}, {"port": 53, "protocol": "TCP"}],
}


def policies() -> list[Policy]:
    """Return the network policies."""
    on_the_bus = sorted(
        role.name
        for role in roles().values()
        if role.takes or role.gives or role.serves or role.calls
    )
    whoever = {"matchExpressions": [{"key": "role", "operator": "In", "values": on_the_bus}]}
    return [
        _policy("nobody", {}, ingress=[], egress=[]),
        _policy("bus", whoever, egress=[{"to": [ROUTER], "ports": BUS}, NAMES]),
        _policy(
            "router",
            ROUTER["podSelector"],
            ingress=[{"from": [{"podSelector": whoever}], "ports": BUS}],
        ),
    ]


def _policy(name: str, pods: Policy, **rules: list[Policy]) -> Policy:
    spec = {"podSelector": pods, "policyTypes": [kind.capitalize() for kind in rules], **rules}
    return {
        "apiVersion": "networking.k8s.io/v1",
        "kind": "NetworkPolicy",
        "metadata": {"name": name},
        "spec": spec,
    }


def as_yaml() -> str:
    """Return them as they stand in the file."""
    told = (
        yaml.safe_dump(one, sort_keys=False, default_flow_style=None, width=120)
        for one in policies()
    )
    return "# Made by policies.py.\n" + "---\n".join(told)


if __name__ == "__main__":
    print(as_yaml(), end="")  # noqa: T201 - what it is for
