"""Version for which plug-ins are made."""

PLUGIN_SYSTEM_VERSION = "0.1"


def satisfies_version(version: str, caret_range: str) -> None:
    if caret_range != f"^{version}":
        raise RuntimeError(f"expected plug-in system {caret_range}, not {version}")
