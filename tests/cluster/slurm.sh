#!/usr/bin/env bash
# Run a small table on a real Slurm of one node, this machine, and check the records.
#
#     apt-get install slurm-wlm munge      # as root, once; this script installs nothing
#     tests/cluster/slurm.sh
#
# munged, slurmctld and slurmd run from a temporary folder, with a key and ports of their own, and end with the script.
# Exit status 0: the records are right; 1: they are not; 77: skipped, and why.
set -euo pipefail
cd "$(dirname "$0")/../.."

skip() { echo "skipped: $*"; exit 77; }
[ "$(id -u)" = 0 ] || skip "slurmd starts jobs as other users and has to be root"
for program in munged slurmctld slurmd sbatch; do
    command -v "$program" > /dev/null || PATH="$PATH:/usr/sbin"
    command -v "$program" > /dev/null || skip "$program is not installed (Debian: apt-get install slurm-wlm munge)"
done
python="$PWD/${VENV:-.venv}/bin/python"
"$python" -c "import distributed, dask_jobqueue" 2> /dev/null || skip "the extra 'cluster' is not installed (pip install -e '.[cluster]')"

work=$(mktemp -d /tmp/rewild4d-slurm.XXXXXX)
chmod 755 "$work"  # munged wants a socket that all can reach
cleanup() {
    for name in slurmd slurmctld munged; do
        [ ! -s "$work/$name.pid" ] || kill "$(cat "$work/$name.pid")" 2> /dev/null || true
    done
    sleep 1
    [ -n "${KEEP:-}" ] || rm -rf "$work"
}
trap cleanup EXIT
node=$(hostname -s)
port() { "$python" -c "import socket; s = socket.socket(); s.bind(('127.0.0.1', 0)); print(s.getsockname()[1])"; }

head -c 128 /dev/urandom > "$work/munge.key"
chmod 600 "$work/munge.key"
munged --socket="$work/munge.socket" --key-file="$work/munge.key" --pid-file="$work/munged.pid" \
    --log-file="$work/munged.log" --seed-file="$work/munged.seed" || skip "munged does not start: $(tail -n 2 "$work/munged.log")"

mkdir -p "$work/state" "$work/spool"
cat > "$work/slurm.conf" << CONF
ClusterName=rewild4d
SlurmctldHost=$node(127.0.0.1)
SlurmctldPort=$(port)
SlurmdPort=$(port)
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket=$work/munge.socket
CredType=cred/munge
StateSaveLocation=$work/state
SlurmdSpoolDir=$work/spool
SlurmctldPidFile=$work/slurmctld.pid
SlurmdPidFile=$work/slurmd.pid
SlurmctldLogFile=$work/slurmctld.log
SlurmdLogFile=$work/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
MpiDefault=none
ReturnToService=2
MinJobAge=7200
SchedulerType=sched/backfill
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
JobAcctGatherType=jobacct_gather/none
NodeName=$node NodeAddr=127.0.0.1 CPUs=$(nproc) RealMemory=$(slurmd -C | grep -o "RealMemory=[0-9]*" | cut -d= -f2) State=UNKNOWN
PartitionName=all Nodes=$node Default=YES MaxTime=INFINITE State=UP
CONF
export SLURM_CONF="$work/slurm.conf"
slurmctld || skip "slurmctld does not start: $(tail -n 2 "$work/slurmctld.log")"
slurmd || skip "slurmd does not start: $(tail -n 2 "$work/slurmd.log")"
for _ in $(seq 60); do
    state=$(sinfo --noheader --format=%t 2> /dev/null || true)
    [ "$state" != idle ] || break
    sleep 0.5
done
[ "$state" = idle ] || skip "the node is '$state' and not idle: $(tail -n 3 "$work/slurmd.log")"
echo "$(slurmctld -V), $(munged --version | head -n 1), node $node with $(nproc) cores, $(date -u +%F)"
"$python" tests/cluster/slurm_table.py "$work/table"
