"""Download of the software of a machine: ``fog-fetch SOFTWARE.json FOLDER``, with Python's standard library only.

I/O; its source travels in user data, and runs before anything is installed. The server's certificate is pinned. A file
appears in FOLDER only when its size and SHA-256 are those of the manifest; files that are there with that content are
not fetched again, and archives of a workspace that the manifest no longer has are removed.
"""

import hashlib
import json
import os
import ssl
import sys
import urllib.request

TIMEOUT_S = 30
PIECE_BYTES = 1 << 20
MANIFEST_MAX_BYTES = 1 << 20


def fetch(described: "dict[str, str]", folder: str) -> None:
    """Fetch all files; raises OSError if one cannot be had now, or is not what the manifest says."""
    trust = ssl.create_default_context(cadata=described["certificate"])
    trust.check_hostname = False  # exactly this certificate is trusted, whatever address leads to it
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}), urllib.request.HTTPSHandler(context=trust))
    url = described["url"]
    manifest = os.path.join(folder, "manifest.json")
    _get(opener, url, manifest, described["manifest"], MANIFEST_MAX_BYTES)
    with open(manifest, "rb") as file:
        files = json.load(file)
    lines = []
    _remove_others(os.path.join(folder, "workspace"), {os.path.basename(each["name"]) for each in files})
    for each in files:
        path = os.path.join(folder, each["name"])
        _get(opener, url, path, each["sha256"], each["size"])
        if path.endswith(".whl"):
            lines.append(f"{path} --hash=sha256:{each['sha256']}\n")
    with open(os.path.join(folder, "requirements.txt"), "w") as file:
        file.writelines(lines)


def _get(opener: urllib.request.OpenerDirector, url: str, path: str, sha256: str, most_bytes: int) -> None:
    if os.path.exists(path) and _sha256(path) == sha256:
        return
    os.makedirs(os.path.dirname(path), exist_ok=True)
    found, size = hashlib.sha256(), 0
    with opener.open(url + "/" + sha256, timeout=TIMEOUT_S) as answer, open(path + ".part", "wb") as file:
        while size <= most_bytes:
            piece = answer.read(PIECE_BYTES)
            if not piece:
                break
            size += len(piece)
            found.update(piece)
            file.write(piece)
    if size > most_bytes or found.hexdigest() != sha256:
        raise OSError(f"{path} is not the file that was promised")
    os.replace(path + ".part", path)


def _sha256(path: str) -> str:
    found = hashlib.sha256()
    with open(path, "rb") as file:
        while piece := file.read(PIECE_BYTES):
            found.update(piece)
    return found.hexdigest()


def _remove_others(folder: str, kept: "set[str]") -> None:
    for name in os.listdir(folder) if os.path.isdir(folder) else ():
        if name not in kept:
            os.remove(os.path.join(folder, name))


if __name__ == "__main__":
    with open(sys.argv[1], "rb") as given:
        fetch(json.load(given), sys.argv[2])
