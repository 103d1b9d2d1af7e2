"""A virtual machine that boots a stock kernel, loads the `vivid` camera driver and runs a script of ours in it.

Containers and test machines rarely may load kernel modules, so that the camera lives in a guest. It boots from memory
into the host's own file system, read-only, and so runs the very Python environment that runs the tests, wherever it
lies. Only /run and /mnt can be written to.

`python -m tests.vm.machine` fetches the kernel into ~/.cache/splatnode/kernel, or where $SPLATNODE_VM_KERNEL says.
Both need Debian's packages qemu-system-x86 and busybox-static.
"""

from __future__ import annotations

import gzip
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from tests.conftest import ROOT

# In the order in which they depend on each other; what this kernel has built in is not there as a file.
MODULES = (
    "virtio_ring",
    "virtio",
    "virtio_pci_modern_dev",
    "virtio_pci_legacy_dev",
    "virtio_pci",
    "netfs",
    "fscache",
    "9pnet",
    "9pnet_virtio",
    "9p",
    "rc-core",
    "cec",
    "mc",
    "videodev",
    "videobuf2-common",
    "videobuf2-memops",
    "videobuf2-v4l2",
    "videobuf2-vmalloc",
    "videobuf2-dma-contig",
    "v4l2-dv-timings",
    "v4l2-tpg",
    "vivid",
)
VIVID_OPTIONS = "n_devs=1 node_types=0x1 num_inputs=1 input_types=0x0 no_error_inj=0"
# With a second device: what is written to it is what the first one sees, once its control "Loop Video" is on (S-Video).
VIVID_LOOP = "n_devs=1 node_types=0x101 num_inputs=1 input_types=0x2 num_outputs=1 output_types=0x0"

INIT = """#!/bin/busybox sh
export PATH=/bin
/bin/busybox --install -s /bin
mount -t proc none /proc
mount -t sysfs none /sys
mount -t devtmpfs none /dev
for module in {modules}; do
    case $module in vivid) insmod /modules/vivid.ko {vivid};; *) insmod /modules/$module.ko;; esac
done
mount -t 9p -o trans=virtio,version=9p2000.L,msize=512000,ro,cache=loose hostroot /root
mount --bind /dev /root/dev
mount --bind /proc /root/proc
mount --bind /sys /root/sys
mount -t tmpfs none /root/run
mount -t 9p -o trans=virtio,version=9p2000.L,msize=512000 out /root/mnt
ip link set lo up
chroot /root /usr/bin/env -i HOME=/tmp PATH=/usr/bin:/bin:/usr/sbin:/sbin PYTHONPATH={root} PYTHONDONTWRITEBYTECODE=1 \\
    {python} {script} > /root/mnt/output 2>&1
echo $? > /root/mnt/code
sync
poweroff -f
"""


@dataclass(frozen=True)
class Kernel:
    image: Path
    modules: Path


@dataclass(frozen=True)
class Outcome:
    code: int
    output: str
    files: Path  # what the script wrote to /mnt


def kernel_folder() -> Path:
    return Path(os.environ.get("SPLATNODE_VM_KERNEL", "~/.cache/splatnode/kernel")).expanduser()


def find_kernel() -> Kernel | str:
    """The kernel, or what is missing."""
    for program in ("qemu-system-x86_64", "busybox"):
        if shutil.which(program) is None:
            return f"{program} is not installed"
    images = sorted(kernel_folder().glob("boot/vmlinuz-*"))
    if not images:
        return f"no kernel in {kernel_folder()}; run: python -m tests.vm.machine"
    modules = images[-1].parent.parent / "lib/modules" / images[-1].name.removeprefix("vmlinuz-")
    if not list(modules.rglob("vivid.ko")):
        return f"no vivid driver in {modules}"
    return Kernel(images[-1], modules)


def run(
    kernel: Kernel, script: Path, files: Path, timeout_s: float = 240, vivid_options: str = VIVID_OPTIONS
) -> Outcome:
    """Boots, runs `script` with this Python, and shuts down. `files` is the guest's writable /mnt."""
    with tempfile.TemporaryDirectory() as folder:
        memory_disk = Path(folder, "initramfs.gz")
        memory_disk.write_bytes(gzip.compress(initramfs(kernel, script, vivid_options), compresslevel=1))
        shares = "multidevs=remap,security_model=none"
        command = [
            *("qemu-system-x86_64", "-accel", "tcg,thread=multi", "-cpu", "max", "-smp", "2"),
            *("-m", "3072", "-kernel", str(kernel.image), "-initrd", str(memory_disk), "-nographic", "-no-reboot"),
            *("-append", "console=ttyS0 quiet panic=-1", "-nic", "none"),
            *("-virtfs", f"local,path=/,mount_tag=hostroot,readonly=on,{shares}"),
            *("-virtfs", f"local,path={files},mount_tag=out,{shares}"),
        ]
        console = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=timeout_s, errors="replace"
        )
    if not (files / "code").exists():
        raise RuntimeError(f"the machine did not get to the script:\n{console.stdout[-3000:]}{console.stderr[-1000:]}")
    return Outcome(int((files / "code").read_text()), (files / "output").read_text(errors="replace"), files)


def initramfs(kernel: Kernel, script: Path, vivid_options: str) -> bytes:
    """A cpio archive (newc, see the kernel's early-userspace/buffer-format.rst) with busybox, modules and INIT."""
    found = {path.stem: path for path in kernel.modules.rglob("*.ko")}
    modules = [name for name in MODULES if name in found]
    init = INIT.format(
        modules=" ".join(modules), vivid=vivid_options, root=ROOT, python=sys.executable, script=script.resolve()
    )
    busybox = shutil.which("busybox")
    if busybox is None:
        raise RuntimeError("busybox is not installed")
    folders = ("bin", "dev", "proc", "sys", "root", "modules")
    entries = [(name, 0o040755, b"") for name in folders]
    entries += [("init", 0o100755, init.encode()), ("bin/busybox", 0o100755, Path(busybox).read_bytes())]
    entries += [(f"modules/{name}.ko", 0o100644, found[name].read_bytes()) for name in modules]
    return b"".join(_cpio_entry(*entry) for entry in [*entries, ("TRAILER!!!", 0, b"")])


def _cpio_entry(name: str, mode: int, content: bytes) -> bytes:
    fields = (0, mode, 0, 0, 1, 0, len(content), 0, 0, 0, 0, len(name) + 1, 0)
    head = b"070701" + b"".join(b"%08X" % field for field in fields) + name.encode() + b"\0"
    return _padded(head) + _padded(content)


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % 4)


def fetch_kernel() -> None:
    """Debian's stock kernel, unpacked and not installed."""
    with tempfile.TemporaryDirectory() as folder:
        query = ["apt-cache", "depends", "--important", "linux-image-amd64"]
        answer = subprocess.run(query, capture_output=True, text=True, check=True).stdout
        package = answer.split("Depends: ")[1].split()[0]  # the newest of this release
        subprocess.run(["apt-get", "download", package], cwd=folder, check=True)
        kernel_folder().mkdir(parents=True, exist_ok=True)
        (archive,) = Path(folder).glob("*.deb")
        subprocess.run(["dpkg-deb", "-x", str(archive), str(kernel_folder())], check=True)


if __name__ == "__main__":
    if isinstance(find_kernel(), str):
        fetch_kernel()
    found = find_kernel()
    print(found)
    sys.exit(isinstance(found, str))
