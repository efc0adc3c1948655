"""SQLite file whose tables are classes: columns are attributes, and rows are objects.

Every change is one transaction. SQLite's rollback journal restores the state before a transaction whose process was
killed or whose disk was full, and SQLite's lock ends with its process.
Network file systems are refused, because their locks do not reliably protect a database from two machines.
"""

import os
import re
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import MISSING, Field, asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

from pisigma.files.errors import OutputError, Place

LOCK_TIMEOUT = 10.0
"""Longest waiting time for another process that writes [s]."""

Row = TypeVar("Row")
_SQL_TYPES: dict[Any, str] = {
    str: "TEXT NOT NULL",
    int: "INTEGER NOT NULL",
    bool: "INTEGER NOT NULL",
    float: "REAL NOT NULL",
    float | None: "REAL",
    bytes: "BLOB NOT NULL",
}
"""SQL types of columns by types of attributes; attributes of any other type are texts."""


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
"""Types of file systems to which several machines can write, by their names in mount tables."""
MOUNTINFO = Path("/proc/self/mountinfo")
"""File with the table of mounts on Linux."""
_TYPES: dict[tuple[Path, int], str | None] = {}
"""Cached results of `_network_type`, by mount table and device number (which changes with the mounted file system)."""
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

    proc(5) defines the format: the fifth field is the mount point, with spaces as octal escapes, and the first field
    after " - " is the type.
    """
    mounts = []
    for line in mountinfo.splitlines():
        fields, _, source = line.partition(" - ")
        if source and len(fields.split()) > 4:
            point = re.sub(r"\\([0-7]{3})", lambda match: chr(int(match[1], 8)), fields.split()[4])
            mounts.append((point, source.split()[0]))
    return mounts


def macos_mounts(mount_output: str) -> list[tuple[str, str]]:
    """Return mount point and type of every file system in the output of the macOS command `mount`."""
    return [(match["point"], match["type"]) for match in _MACOS_MOUNT.finditer(mount_output)]


def file_system_type(path: str, mounts: Iterable[tuple[str, str]]) -> str | None:
    """Return the type of the file system that contains a path.

    Args:
        path: an absolute path without symbolic links.
        mounts: mount points and types in the order of mounting; a later mount hides an earlier mount at the same place.

    Returns:
        The type, such as "ext4" or "nfs4"; None if no mount point contains the path.
    """
    containing = [(len(point), kind) for point, kind in mounts if Path(path).is_relative_to(point)]
    longest = max((length for length, _ in containing), default=0)
    return next((kind for length, kind in reversed(containing) if length == longest), None)


@dataclass(frozen=True)
class Table:
    """A table of a database.

    Attributes:
        name: name of the table.
        key: columns that identify a row; a new row replaces a row with equal values in these. If empty, every row is
            kept.
    """

    name: str
    key: tuple[str, ...] = ()


@dataclass(frozen=True)
class Database:
    """An SQLite file with tables for some classes.

    Attributes:
        path: path of the file, which is created with the first row.
        tables: table of every class.
        version: version of the schema, which the file states as `PRAGMA user_version`.
        import_earlier_data: function that adds data that an earlier version stored in other files, within the
            transaction that upgrades the file; it returns the files to remove after the transaction.
    """

    path: Path
    tables: Mapping[type, Table]
    version: int
    import_earlier_data: Callable[[sqlite3.Connection], Sequence[Path]]
    _snapshot: list[sqlite3.Connection] = field(default_factory=list, repr=False, compare=False)

    def add_or_replace(self, rows: Sequence[Any]) -> None:
        """Add rows in one transaction; a row with the same key is replaced.

        Raises:
            OutputError: the file cannot be written; see `open`.
        """
        with self.transaction() as database:
            self.insert(database, rows)

    def insert(self, database: sqlite3.Connection, rows: Sequence[Any]) -> None:
        """Add rows in a transaction; a row with the same key is replaced."""
        for row in rows:
            values = asdict(row)
            names, marks = ", ".join(values), ", ".join("?" * len(values))
            table = self.tables[type(row)].name
            database.execute(f"INSERT OR REPLACE INTO {table} ({names}) VALUES ({marks})", [*values.values()])

    def read(self, kind: type[Row]) -> tuple[Row, ...]:
        """Return all rows of a class in the order in which they were added; empty if there is no file yet.

        Raises:
            OutputError: the file cannot be read; see `open`.
        """
        if not self.path.exists():
            return ()
        columns = fields(kind)  # type: ignore[arg-type]  # classes with a table are dataclasses
        names = ", ".join(one.name for one in columns)
        with self.open() as database:
            rows = database.execute(f"SELECT {names} FROM {self.tables[kind].name} ORDER BY rowid").fetchall()
        booleans = [one.type is bool for one in columns]
        return tuple(
            kind(*(bool(value) if is_bool else value for is_bool, value in zip(booleans, row, strict=True)))
            for row in rows
        )

    def upgrade(self) -> int:
        """Upgrade the file to the current version of the schema; return its previous version.

        Raises:
            OutputError: the file cannot be upgraded; see `open`.
        """
        with self._connected() as (database, before):
            if before < self.version:
                self._upgrade(database)
        return before

    def copy(self, path: Path) -> None:
        """Write a copy of the file without the changes that other processes are making.

        Raises:
            OutputError: the file cannot be read, or the copy cannot be written; see `open`.
        """
        with self.open() as database:
            try:
                with closing(sqlite3.connect(path)) as other:
                    database.backup(other)
            except sqlite3.Error as problem:
                raise OutputError(f"the history cannot be copied: {problem}", at=Place(path.parent)) from None

    @contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """Open the file for changes that are made all together or not at all; other processes wait before they write.

        Raises:
            OutputError: the file cannot be written; see `open`.
        """
        with self.open() as database, _transaction(database):
            yield database

    @contextmanager
    def open(self) -> Iterator[sqlite3.Connection]:
        """Open the file; a file of an earlier version is first upgraded, completely or not at all.

        Raises:
            OutputError: the file is not a database, has a newer version, cannot be opened or upgraded, or is on a
                network file system.
        """
        if self._snapshot:
            yield self._snapshot[0]
            return
        with self._connected() as (database, version):
            if version < self.version:
                self._upgrade(database)
            yield database

    @contextmanager
    def snapshot(self) -> Iterator[None]:
        """Make all reads in the block see the same state of the file, with one connection.

        Raises:
            OutputError: see `open`.
        """
        if not self.path.exists():
            yield
            return
        with self.open() as database:
            database.execute("BEGIN")
            self._snapshot.append(database)
            try:
                yield
            finally:
                self._snapshot.clear()

    @contextmanager
    def _connected(self) -> Iterator[tuple[sqlite3.Connection, int]]:
        """Yield a connection and the version of the schema; 0 for an empty file."""
        check_local(self.path.parent)
        try:
            with closing(sqlite3.connect(self.path, timeout=LOCK_TIMEOUT, isolation_level=None)) as database:
                version = _version(database)
                if version > self.version:
                    raise OutputError(
                        expected=f"a history of schema version {self.version} or older",
                        value=version,
                        at=Place(self.path),
                        remedy="update pisigma",
                    )
                yield database, version
        except sqlite3.Error as problem:
            raise OutputError(
                f"the history cannot be used: {problem}",
                at=Place(self.path),
                remedy="check that it is an SQLite file, that the folder is writable, and that the disk is not full",
            ) from None

    def _upgrade(self, database: sqlite3.Connection) -> None:
        """Add missing tables and columns, and data that an earlier version stored elsewhere."""
        with _transaction(database):
            if _version(database) >= self.version:  # another process was faster
                return
            for kind, table in self.tables.items():
                columns = {one.name: _column(one) for one in fields(kind)}
                key = f", PRIMARY KEY ({', '.join(table.key)})" if table.key else ""
                database.execute(
                    f"CREATE TABLE IF NOT EXISTS {table.name} ({', '.join(columns.values())}{key})"
                )
                stored = [row[1] for row in database.execute(f"PRAGMA table_info({table.name})")]
                for name in [name for name in columns if name not in stored]:
                    database.execute(f"ALTER TABLE {table.name} ADD COLUMN {columns[name]}")
            moved = self.import_earlier_data(database)
            database.execute(f"PRAGMA user_version = {self.version}")
        for file in moved:
            file.unlink(missing_ok=True)


@contextmanager
def _transaction(database: sqlite3.Connection) -> Iterator[None]:
    """Make either all changes in the block or none of them."""
    database.execute("BEGIN IMMEDIATE")  # waits for another process that writes
    try:
        yield
        database.execute("COMMIT")
    finally:
        if database.in_transaction:
            database.execute("ROLLBACK")


def _version(database: sqlite3.Connection) -> int:
    return int(database.execute("PRAGMA user_version").fetchone()[0])


def _column(attribute: "Field[Any]") -> str:
    """Return the declaration of a column; its default is that of the attribute."""
    declared = f"{attribute.name} {_SQL_TYPES.get(attribute.type, _SQL_TYPES[str])}"
    if attribute.default in (MISSING, None):
        return declared
    default = int(attribute.default) if attribute.type is bool else attribute.default
    value = str(default).replace("'", "''")
    return f"{declared} DEFAULT '{value}'"
