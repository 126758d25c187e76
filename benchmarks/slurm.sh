#!/bin/bash
# A sweep on a Slurm of one node, from its start to its end: six jobs, one that fails, one that is killed, and the sweep again.
#
#   apt-get install slurm-wlm slurmdbd munge mariadb-server
#   pip install -e '.[slurm]'
#   benchmarks/slurm.sh [folder]            as root, in a container or a virtual machine of its own
#
# It starts munge, MariaDB and Slurm's daemons with files in that folder, and ends Slurm's again. What it expects is checked.
set -euo pipefail

work=$(realpath -m "${1:-/tmp/hno-slurm}")
hno="${PYTHON:-python} -m hno"
host=$(hostname -s)
rm -rf "$work" && mkdir -p "$work/conf" "$work/state" "$work/log" && chmod 755 "$work" && chown slurm "$work/state" "$work/log"
export SLURM_CONF="$work/conf/slurm.conf" HNO_CACHE="${HNO_CACHE:-$work/labels}"

cat > "$SLURM_CONF" <<END
ClusterName=one
SlurmctldHost=$host
SlurmUser=slurm
AuthType=auth/munge
AccountingStorageType=accounting_storage/slurmdbd
AccountingStorageHost=localhost
JobAcctGatherType=jobacct_gather/linux
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
StateSaveLocation=$work/state
SlurmdSpoolDir=$work/spool
SlurmctldPidFile=$work/slurmctld.pid
SlurmdPidFile=$work/slurmd.pid
SlurmctldLogFile=$work/log/slurmctld
SlurmdLogFile=$work/log/slurmd
ReturnToService=2
NodeName=$host Sockets=1 CoresPerSocket=${CPUS:-$(nproc --all)} ThreadsPerCore=1 State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
END
cat > "$work/conf/slurmdbd.conf" <<END
AuthType=auth/munge
DbdHost=localhost
SlurmUser=slurm
StorageType=accounting_storage/mysql
StorageUser=slurm
StoragePass=one
StorageLoc=hno_slurm
LogFile=$work/log/slurmdbd
PidFile=$work/state/slurmdbd.pid
END
chown slurm "$work/conf/slurmdbd.conf" && chmod 600 "$work/conf/slurmdbd.conf"

pgrep -x munged > /dev/null || service munge start
pgrep -x mariadbd > /dev/null || service mariadb start
mysql -e "drop database if exists hno_slurm; create user if not exists slurm@localhost identified by 'one'; grant all on hno_slurm.* to slurm@localhost"
daemons=()
trap 'scancel --full --signal=KILL --user=root; sleep 2; kill "${daemons[@]}" 2> /dev/null || true' EXIT
runuser -u slurm -- env SLURM_CONF="$SLURM_CONF" slurmdbd -D & daemons+=($!)
for _ in $(seq 60); do sacctmgr -n show cluster > /dev/null 2>&1 && break || sleep 1; done
sacctmgr -i add cluster one > /dev/null 2>&1 || true
slurmctld -D & daemons+=($!)
slurmd -D & daemons+=($!)
for _ in $(seq 60); do sinfo -h -o %T | grep -qE "idle|mix" && break || sleep 1; done
sinfo

sweep="$work/sweep"
words=(experiment=smoke "data.types=[[1,1]]" evaluation.dt=0.25 trainer.max_steps=${STEPS:-200} trainer.validate_every=20)
words+=("optimizer.lr=1e-3,2e-3,3e-3,4e-3,5e-3,1e30")
$hno train -m launcher=slurm "${words[@]}" --to "$sweep" & run=$!

job=$sweep/1_narrow_road_hno_auto_sin_lr-0.002
until [ -f "$job/last.ckpt" ]; do sleep 0.2; done
pid=$(grep -o '"process": \["[^"]*", [0-9]*' "$sweep"/.jobs-*/1.json | grep -o '[0-9]*$')
echo "killing process $pid of job 1"
kill -KILL "$pid"
wait $run && exit 1 || echo "The sweep ended with exit code $?."
while [ -n "$(squeue -h)" ]; do sleep 1; done
first=$(wc -l < "$sweep/sweep.log")

$hno train sweep="$sweep" launcher=slurm && exit 1 || echo "Again, it ended with exit code $?."
tail -n +$((first + 1)) "$sweep/sweep.log" | cut -c 1-100
for expected in "skipped 4" "resumed 1" "repeated 1" "finished 5" "failed 1"; do
    set -- $expected
    [ "$(tail -n +$((first + 1)) "$sweep/sweep.log" | grep -c "$1")" = "$2" ] || { echo "expected $2 $1"; exit 1; }
done
srun --version
$hno --version
echo "As expected: of six jobs four were skipped, the one that was killed was resumed, the one that failed was repeated."
