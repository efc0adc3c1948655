"""File systems of networks are found in tables of mounts, and refused for histories."""

import pytest
from testing.refusals import refused

from pisigma.files.errors import OutputError
from pisigma.lifetime.cell import database
from pisigma.lifetime.cell.database import NETWORK_TYPES, file_system_type, linux_mounts, macos_mounts
from pisigma.lifetime.cell.history import History

MOUNTINFO = r"""22 27 0:21 / /proc rw,relatime - proc proc rw
27 1 254:0 / / rw,relatime shared:1 - ext4 /dev/vda rw,discard
40 27 0:50 / /srv rw,relatime shared:2 master:3 - autofs systemd-1 rw,fd=30
41 40 0:51 / /srv rw,relatime - nfs4 server:/export rw,vers=4.2,local_lock=none
42 41 0:52 / /srv/fast rw,relatime - xfs /dev/vdb rw
43 27 0:53 / /mnt/cells\040of\040hall\0403 rw - cifs //nas/cells rw
44 27 0:54 / /home/me/remote rw - fuse.sshfs me@host: rw
a line that is cut
"""
MACOS = """/dev/disk3s1s1 on / (apfs, sealed, local, read-only, journaled)
//me@nas/cells on /Volumes/cells (one) (smbfs, nodev, nosuid, mounted by me)
"""


@pytest.mark.parametrize(
    ("path", "kind"),
    [
        ("/srv/cells/welder7", "nfs4"),
        ("/srv", "nfs4"),
        ("/srv/fast/cells", "xfs"),
        ("/srv2/cells", "ext4"),
        ("/mnt/cells of hall 3/a", "cifs"),
        ("/home/me/remote/a", "fuse.sshfs"),
        ("/home/me", "ext4"),
    ],
)
def test_the_last_and_deepest_mount_is_used(path, kind):
    assert file_system_type(path, linux_mounts(MOUNTINFO)) == kind


def test_the_table_of_macos_is_read():
    mounts = macos_mounts(MACOS)
    assert file_system_type("/Volumes/cells (one)/a", mounts) == "smbfs"
    assert file_system_type("/Users/me", mounts) == "apfs"


def test_nothing_is_known_without_mounts():
    assert file_system_type("/srv", []) is None


def test_local_file_systems_are_not_those_of_networks():
    assert NETWORK_TYPES.isdisjoint({"ext4", "xfs", "btrfs", "tmpfs", "overlay", "apfs", "zfs", "virtiofs"})


@pytest.mark.parametrize(
    "kind", ["nfs", "nfs4", "cifs", "smb3", "9p", "fuse.sshfs", "ceph", "lustre", "ext4"]
)
def test_a_history_on_the_file_system_of_a_network_is_refused(tmp_path, monkeypatch, kind):
    table = tmp_path / "mountinfo"
    table.write_text(f"{MOUNTINFO}50 27 0:60 / {tmp_path} rw - {kind} host:/export rw\n", encoding="utf-8")
    monkeypatch.setattr(database, "MOUNTINFO", table)
    history = History(tmp_path / "history.sqlite")
    if kind == "ext4":
        history.record("firmware")
        return
    with refused(OutputError, file=tmp_path, value=kind):
        history.record("firmware")
    history.path.touch()
    with refused(OutputError, file=tmp_path, value=kind):
        history.events()
