"""Detect network file systems, whose locks do not reliably protect a database from two machines."""

import os
import re
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

from pisigma.files.errors import OutputError, Place

NETWORK_TYPES = frozenset(
    {
        *(
            "9p",
            "afp",
            "afpfs",
            "afs",
            "beegfs",
            "ceph",
            "cifs",
            "coda",
            "davfs",
            "gfs2",
            "glusterfs",
            "gpfs",
        ),
        *("lustre", "ncpfs", "nfs", "nfs4", "ocfs2", "orangefs", "pvfs2", "smb2", "smb3", "smbfs", "webdav"),
        *("fuse.ceph", "fuse.cephfs", "fuse.davfs", "fuse.gcsfuse", "fuse.glusterfs", "fuse.gvfsd-fuse"),
        *("fuse.juicefs", "fuse.rclone", "fuse.s3fs", "fuse.smbnetfs", "fuse.sshfs"),
    }
)
"""Types of file systems that several machines can write to, by their names in mount tables."""
MOUNTINFO = Path("/proc/self/mountinfo")
"""File with the table of mounts on Linux."""
_TYPES: dict[tuple[Path, int], str | None] = {}
"""Cached results of `_network_type` by mount table and device number, which changes with the mounted file system."""
_DRIVE_REMOTE = 4
"""Return value of the Windows function `GetDriveTypeW` for a network drive."""
_MACOS_MOUNT = re.compile(r"^.* on (?P<point>/.*) \((?P<type>\w+)[,)]", re.MULTILINE)
"""A line of the macOS command `mount`: ``//user@server/share on /Volumes/share (smbfs, nodev)``."""


def check_local(folder: Path) -> None:
    """Check that a folder for a database is not on a network file system.

    Args:
        folder: the folder; a folder that does not exist is not checked.

    Raises:
        OutputError: the folder is on a network file system.
    """
    try:
        device = os.stat(folder).st_dev
    except OSError:
        return
    if (
        MOUNTINFO,
        device,
    ) not in _TYPES:  # cached, because for many folders reading the table takes longer than everything else
        _TYPES[MOUNTINFO, device] = _network_type(os.path.realpath(folder))
    if kind := _TYPES[MOUNTINFO, device]:
        raise OutputError(
            expected="a folder on a local disk, because locks of network file systems cannot protect a history",
            value=kind,
            at=Place(folder),
            remedy="copy it to a local disk",
        )


def _network_type(folder: str) -> str | None:
    """Return the type of the network file system that contains a folder; None for a local disk or an unknown type.

    Args:
        folder: the real path of the folder.
    """
    if sys.platform == "win32":
        import ctypes

        drive = os.path.splitdrive(folder)[0]
        remote = ctypes.windll.kernel32.GetDriveTypeW(f"{drive}\\") == _DRIVE_REMOTE
        return "network drive" if remote or drive.startswith("\\\\") else None
    try:
        if sys.platform == "darwin":
            mounts = macos_mounts(subprocess.run(["/sbin/mount"], capture_output=True, text=True).stdout)
        else:
            mounts = linux_mounts(MOUNTINFO.read_text(encoding="utf-8", errors="replace"))
    except OSError:  # this system has no table of mounts
        return None
    kind = file_system_type(folder, mounts)
    return kind if kind in NETWORK_TYPES else None


def linux_mounts(mountinfo: str) -> list[tuple[str, str]]:
    """Return mount point and type of every file system in a table such as `/proc/self/mountinfo`.

    proc(5) defines the format: the fifth field is the mount point, with blanks as octal escapes, and the first field
    after " - " is the type.
    """
    mounts = []
    for line in mountinfo.splitlines():
        fields, _, source = line.partition(" - ")
        if source and len(fields.split()) > 4:
            point = re.sub(r"\\([0-7]{3})", lambda match: chr(int(match[1], 8)), fields.split()[4])
            mounts.append((point, source.split()[0]))
    return mounts


def macos_mounts(printed: str) -> list[tuple[str, str]]:
    """Return mount point and type of every file system in the output of the macOS command `mount`."""
    return [(match["point"], match["type"]) for match in _MACOS_MOUNT.finditer(printed)]


def file_system_type(path: str, mounts: Iterable[tuple[str, str]]) -> str | None:
    """Return the type of the file system that contains a path.

    Args:
        path: an absolute path without links.
        mounts: mount points and types in the order of mounting; a later mount hides an earlier one at the same place.

    Returns:
        The type, such as "ext4" or "nfs4"; None if no mount point contains the path.
    """
    containing = [(len(point), kind) for point, kind in mounts if Path(path).is_relative_to(point)]
    longest = max((length for length, _ in containing), default=0)
    return next((kind for length, kind in reversed(containing) if length == longest), None)
