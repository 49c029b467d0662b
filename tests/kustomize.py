"""What of kustomize the overlays in `deploy/kubernetes` use, in some lines, since no package ships it.

Whatever else a kustomization says is refused: an overlay stays so simple, or this is to grow.
"""

import re
from pathlib import Path
from typing import Any, Final

import yaml

Object = dict[str, Any]
_KNOWN: Final = {
    *("apiVersion", "kind", "namespace", "resources", "patches", "images"),
    *("configMapGenerator", "generatorOptions"),
}
#: By which field the entries of a list are told apart where a patch is merged; other lists are replaced.
_KEYS: Final = {"containers": "name", "volumes": "name", "volumeMounts": "mountPath", "env": "name"}
_CLUSTER_WIDE: Final = {"Namespace"}


def built(folder: Path) -> list[Object]:
    """Return the objects of a kustomization, as `kubectl kustomize FOLDER` does."""
    kustomization = yaml.safe_load((folder / "kustomization.yaml").read_text())
    assert set(kustomization) <= _KNOWN, f"{folder}: {set(kustomization) - _KNOWN}"
    objects: list[Object] = []
    for name in kustomization["resources"]:
        path = folder / name
        objects += built(path) if path.is_dir() else yaml.safe_load_all(path.read_text())
    assert kustomization.get("generatorOptions", {"disableNameSuffixHash": True}) == {
        "disableNameSuffixHash": True
    }
    for one in kustomization.get("configMapGenerator", []):
        data = dict(literal.split("=", 1) for literal in one["literals"])
        objects.append(
            {
                "apiVersion": "v1",
                "kind": "ConfigMap",
                "metadata": {"name": one["name"]},
                "data": data,
            }
        )
    for patch in kustomization.get("patches", []):
        told = yaml.safe_load((folder / patch["path"]).read_text())
        target = patch["target"]
        chosen = [one for one in objects if _is(one, target)]
        assert chosen, f"{folder / patch['path']} is of nothing"
        del told["kind"], told["apiVersion"], told["metadata"]["name"]
        for one in chosen:
            one.update(_merged(one, told))
    for container in (container for one in objects for container in containers(one)):
        for image in kustomization.get("images", []):
            name, _, tag = re.fullmatch(r"(.+?)(:([^:/]+))?", container["image"]).groups(default="")
            if name.split("/")[-1] == image["name"]:
                container["image"] = ":".join(
                    filter(None, (image.get("newName", name), image.get("newTag", tag)))
                )
    for one in objects:
        if one["kind"] not in _CLUSTER_WIDE:
            one["metadata"]["namespace"] = kustomization["namespace"]
    return objects


def pods_of(one: Object) -> list[Object]:
    """Return the specifications of the pods that an object has made."""
    if one["kind"] == "DaskCluster":
        return [one["spec"][part]["spec"] for part in ("scheduler", "worker")]
    return [one["spec"]["template"]["spec"]] if "template" in one.get("spec", {}) else []


def containers(one: Object) -> list[Object]:
    """Return the containers of an object's pods."""
    return [container for pod in pods_of(one) for container in pod["containers"]]


def _is(one: Object, target: dict[str, str]) -> bool:
    named = {"kind": one["kind"], "name": one["metadata"]["name"]}
    return all(re.fullmatch(pattern, named[field]) for field, pattern in target.items())


def _merged(one: Any, patch: Any, key: str | None = None) -> Any:
    if isinstance(one, dict) and isinstance(patch, dict):
        return one | {
            name: _merged(one.get(name), value, _KEYS.get(name)) for name, value in patch.items()
        }
    if isinstance(one, list) and key is not None:
        patched = {entry[key]: entry for entry in patch}
        known = [_merged(entry, patched.pop(entry[key], {})) for entry in one]
        return known + list(patched.values())
    return patch
