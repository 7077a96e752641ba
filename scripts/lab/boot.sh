#!/bin/sh
# Init of a booted machine's namespaces: mounts its root and starts systemd in it as process 1.
# $1: folder of the machine, $2: image, $3: its console (a terminal). The caller has made the namespaces: mount, pid,
# uts, ipc, cgroup, net. The file systems are those of systemd's container interface (systemd.io/CONTAINER_INTERFACE).
set -e
machine=$1 image=$2 console=$3 root=$1/root
mount --make-rprivate /
mkdir -p "$machine/upper" "$machine/work" "$root"
mount -t overlay overlay -o "lowerdir=$image,upperdir=$machine/upper,workdir=$machine/work" "$root"
mount -t proc proc "$root/proc"
mount --bind "$root/proc/sys" "$root/proc/sys"
mount --bind "$root/proc/sys/net" "$root/proc/sys/net"
mount -o remount,bind,ro "$root/proc/sys"
mount -t sysfs -o ro,nosuid,nodev,noexec sysfs "$root/sys"
mount -t cgroup2 cgroup2 "$root/sys/fs/cgroup"
mount -t tmpfs -o mode=755 tmpfs "$root/dev"
mkdir "$root/dev/pts" "$root/dev/shm" "$root/dev/net"
mount -t devpts -o newinstance,ptmxmode=0666,mode=620,gid=5 devpts "$root/dev/pts"
ln -s pts/ptmx "$root/dev/ptmx"
ln -s /proc/self/fd "$root/dev/fd"
for device in null zero full random urandom tty net/tun; do
    if [ -e "/dev/$device" ]; then
        touch "$root/dev/$device"
        mount --bind "/dev/$device" "$root/dev/$device"
    fi
done
touch "$root/dev/console"
mount --bind "$console" "$root/dev/console"
mount -t tmpfs -o mode=755 tmpfs "$root/run"
mkdir "$root/old"
cd "$root"
pivot_root . old
umount -l old
rmdir old
exec env -i container=fog PATH=/usr/sbin:/usr/bin:/sbin:/bin /lib/systemd/systemd \
    --log-target=journal </dev/console >/dev/console 2>&1
