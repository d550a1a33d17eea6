"""A store elsewhere: a folder, an S3-compatible bucket, a machine reached by SSH; whatever fsspec can open.

Same layout as in a workspace: ``objects/<kind>/<digest>/…``, ``objects/<kind>/<digest>.sha256``,
``actions/<stage>/<key>.json``. The order of writing is that of a publication: files, then the seal, then the record.
So a folder without its seal is one that is still on its way, and what a killed upload leaves behind is never taken
for a result. Nothing that comes from there is trusted: names are checked before they become paths, and every byte is
hashed on arrival.
"""

from __future__ import annotations

import os
import secrets
import shutil
from pathlib import Path, PurePosixPath
from typing import Any

from pipeline.errors import BadInput
from pipeline.files import sha256_file
from pipeline.objects import digest_of, parse_manifest

_BUCKETS = ("s3", "s3a", "gs", "gcs", "abfs", "az", "oss")
_EXTRAS = {"s3": "s3", "s3a": "s3", "sftp": "ssh", "ssh": "ssh"}


class Remote:
    """The store at a URL (``/a/path``, ``s3://bucket/prefix``, ``ssh://host/path``)."""

    def __init__(self, url: str, options: dict[str, Any] | None = None) -> None:
        """Raises BadInput when the place, or what is needed to reach it, is not there."""
        try:
            import fsspec
        except ImportError as error:
            raise BadInput("other stores need fsspec", hint="pip install fsspec") from error
        self.url = url
        protocol = url.partition("://")[0] if "://" in url else "file"
        try:
            self._fs, root = fsspec.core.url_to_fs(url, **(options or {}))
        except (ImportError, ValueError) as error:
            extra = _EXTRAS.get(protocol)
            hint = f"pip install 'banmo-pipeline[{extra}]'" if extra else ""
            raise BadInput(
                f"this place cannot be reached ({str(error).splitlines()[0]})", where=url, hint=hint
            ) from error
        except Exception as error:
            raise BadInput(f"this place cannot be reached ({type(error).__name__}: {error})", where=url) from error
        self._root = str(root).rstrip("/")
        self._is_local = protocol == "file"
        self._is_bucket = protocol in _BUCKETS

    # ------------------------------------------------------------------ reading

    def read(self, name: str) -> bytes | None:
        """Content of a small file below the root, None when it is not there."""
        self._fs.invalidate_cache()
        try:
            found: bytes = self._fs.cat_file(self._path(name))
            return found
        except (FileNotFoundError, IsADirectoryError, NotADirectoryError, KeyError):
            return None
        except OSError as error:
            raise BadInput(f"it cannot be read ({error})", where=f"{self.url}/{name}") from error

    def names(self, folder: str) -> list[str]:
        """Names of what lies directly in a folder, sorted; none when it is not there."""
        self._fs.invalidate_cache()
        try:
            listed = self._fs.ls(self._path(folder), detail=False)
        except (FileNotFoundError, NotADirectoryError):
            return []
        except OSError as error:
            raise BadInput(f"it cannot be listed ({error})", where=f"{self.url}/{folder}") from error
        names = {PurePosixPath(str(p)).name for p in listed}
        return sorted(n for n in names if n and not n.startswith("."))

    def has(self, kind: str, digest: str) -> bool:
        """Whether the seal of a folder is there: it is written after the folder."""
        return self.read(f"objects/{kind}/{digest}.sha256") is not None

    def complete(self, kind: str, digest: str) -> bool:
        """Whether everything that the seal of a folder names is there, whatever its content."""
        seal = self.read(f"objects/{kind}/{digest}.sha256")
        entries = parse_manifest(seal.decode("utf-8", "replace")) if seal else None
        return bool(entries) and all(
            safe(name) and self._fs.exists(self._path(f"objects/{kind}/{digest}/{name}")) for name in entries or ()
        )

    def fetch(self, kind: str, digest: str, scratch: Path) -> bool:
        """Copy a folder into the empty folder `scratch`, every byte hashed; False when it is not whole there."""
        seal = self.read(f"objects/{kind}/{digest}.sha256")
        try:
            text = (seal or b"").decode()
        except UnicodeDecodeError:
            return False
        entries = parse_manifest(text)
        if not entries or digest_of(text) != digest or not all(safe(n) for n in entries):
            return False
        for name, wanted in entries.items():
            place = scratch / name
            place.parent.mkdir(parents=True, exist_ok=True)
            try:
                self._fs.get_file(self._path(f"objects/{kind}/{digest}/{name}"), str(place))
            except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
                return False
            except OSError as error:
                raise BadInput(f"it cannot be read ({error})", where=f"{self.url}/objects/{kind}/{digest}") from error
            if place.is_symlink() or not place.is_file() or sha256_file(place) != wanted:
                return False
        return True

    # ------------------------------------------------------------------ writing

    def store(self, kind: str, digest: str, folder: Path, seal: Path) -> None:
        """Copy a folder there, and then its seal."""
        base = f"objects/{kind}/{digest}"
        text = seal.read_text(encoding="utf-8")
        if self._is_local:
            self._store_locally(Path(self._root) / "objects" / kind, digest, folder)
        else:
            for name in parse_manifest(text) or {}:
                self._put(folder / name, f"{base}/{name}")
        self.write(f"{base}.sha256", text.encode())

    def write(self, name: str, data: bytes) -> None:
        """Write a small file whole: readers see the old or the new content."""
        path = self._path(name)
        try:
            if self._is_local:
                Path(path).parent.mkdir(parents=True, exist_ok=True)
                temporary = f"{path}.{secrets.token_hex(4)}.tmp"
                Path(temporary).write_bytes(data)
                os.replace(temporary, path)
                return
            self._make_folder(path)
            self._fs.pipe_file(path, data)
        except OSError as error:
            raise BadInput(f"it cannot be written ({error})", where=f"{self.url}/{name}") from error

    def _put(self, source: Path, name: str) -> None:
        path = self._path(name)
        try:
            self._make_folder(path)
            self._fs.put_file(str(source), path)
        except OSError as error:
            raise BadInput(f"it cannot be written ({error})", where=f"{self.url}/{name}") from error

    def _make_folder(self, path: str) -> None:
        """Have the folder of a file. Buckets know no folders, and one that is not there must not be made by a typo."""
        if not self._is_bucket:
            self._fs.makedirs(path.rpartition("/")[0], exist_ok=True)

    def _store_locally(self, parent: Path, digest: str, folder: Path) -> None:
        """Beside its place first, then renamed: others see all of it or nothing."""
        if (parent / digest).is_dir():
            return
        scratch = parent / f".{digest[:12]}-{secrets.token_hex(4)}"
        try:
            shutil.copytree(folder, scratch, copy_function=shutil.copyfile)
            for inner, folders, _ in os.walk(scratch):
                for name in folders:
                    os.chmod(Path(inner) / name, 0o755)
            os.chmod(scratch, 0o755)
            os.rename(scratch, parent / digest)
        except OSError as error:
            shutil.rmtree(scratch, ignore_errors=True)
            if not (parent / digest).is_dir():
                raise BadInput(f"it cannot be written ({error.strerror})", where=parent) from error

    def _path(self, name: str) -> str:
        return f"{self._root}/{name}"


def safe(name: str) -> bool:
    """Whether a name from elsewhere may become a path below a folder of ours."""
    parts = name.split("/")
    plain = all(p not in ("", ".", "..") and "\\" not in p and "\0" not in p for p in parts)
    return plain and not name.startswith("/") and name.isprintable() and len(name.encode("utf-8", "replace")) < 1000
