"""Trials run on the workers of a dask cluster (pip install 'bidnerf[cluster]'): here a cluster on this machine.

    python examples/07_cluster.py [--workers 2] [--trials 8]

On several machines, start `dask scheduler` on one and `dask worker tcp://HOST:8786 --nthreads 1` on each, and give the address of
the scheduler: `bidnerf evaluate MAP DATA --dask tcp://HOST:8786 --out results.jsonl`, or `workers=` as below. Workers read the map
and the data from the same folders, and each finished trial is on disk here, so that the same call resumes what was interrupted.
"""

import argparse

from distributed import LocalCluster

import bidnerf as bn


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--trials", type=int, default=8, help="starts")
    given = parser.parse_args()

    # The peak memory of a trial is that of its process, so that each worker has one thread.
    with LocalCluster(
        n_workers=given.workers, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
    ) as cluster:
        plan = bn.Plan(protocol="bid", sizes=[0.3], method="bid", config={"max_steps": 100}, trials=given.trials)
        print(bn.evaluate("demo:blobs", "demo:blobs", plan, out="results.jsonl", workers=cluster.scheduler_address))


if __name__ == "__main__":  # workers import this file
    main()
