"""Exact search over a million embeddings: time, memory and agreement with scikit-learn and vector libraries.

    python -m benchmarks.search [--quick] [--num 1000000] [--dim 512] [--out FILE.json]

faiss (IndexFlatIP, which copies the bank) and usearch (exact=True, which does not) are included if they are installed
(`pip install faiss-cpu usearch`). Otherwise the result says "not installed". Approximate indices are not compared.

Vectors are random with unit length. Queries are sent one at a time, and engines are interleaved. Each engine runs in
its own process. Memory is the anonymous resident set of the process, minus that after importing the library. It does
not include the memory-mapped bank, which is in the page cache and can be dropped by the system at any time.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import multiprocessing
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mvitac.system.provenance import provenance

OURS = "mvitac"
ENGINES = {
    OURS: "mvitac.deploy.search",
    "scikit-learn": "sklearn.neighbors",
    "faiss": "faiss",
    "usearch": "usearch.index",
}
"""Engine name -> module that it needs."""


def installed() -> list[str]:
    """Return the names of the installed engines, ``mvitac`` first."""
    return [name for name, module in ENGINES.items() if importlib.util.find_spec(module.split(".")[0])]


def searcher(name: str, bank: np.ndarray, k: int, threads: int) -> Callable[[np.ndarray], np.ndarray]:
    """Return an exact search function of one engine.

    The function takes unit queries [Q, E]. It returns the ``k`` rows of ``bank`` [N, E] with the highest cosine, best
    first: [Q, k].
    """
    if name == OURS:
        from mvitac.deploy.search import nearest

        return lambda queries: nearest(bank, queries, k)[0]
    if name == "scikit-learn":
        from sklearn.neighbors import NearestNeighbors

        fitted = NearestNeighbors(n_neighbors=k, algorithm="brute", metric="cosine").fit(bank)
        return lambda queries: fitted.kneighbors(queries, return_distance=False)
    if name == "faiss":
        import faiss  # pyright: ignore[reportMissingImports]

        faiss.omp_set_num_threads(threads)
        flat = faiss.IndexFlatIP(bank.shape[1])
        flat.add(bank)
        return lambda queries: flat.search(queries, k)[1]
    from usearch.index import MetricKind, search  # pyright: ignore[reportMissingImports]

    def find(queries: np.ndarray) -> np.ndarray:
        # The shape of keys is [k] for one query and [Q, k] for several.
        return np.atleast_2d(search(bank, queries, k, MetricKind.IP, exact=True, threads=threads).keys)

    return find


def anonymous_mb() -> dict[str, float]:
    """Return the current anonymous and file-backed resident memory and the peak, in MB (Linux)."""
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return {k: int(lines[k].split()[0]) / 1024 for k in ("RssAnon", "RssFile", "VmHWM")}


def measure(name: str, path: str, num_queries: int, k: int, threads: int, connection: Any) -> None:
    """Measure one engine in this process: answer queries from ``connection`` until "stop", then send the result."""
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = str(threads)
    from threadpoolctl import threadpool_limits

    importlib.import_module(ENGINES[name])
    with threadpool_limits(threads):
        before = anonymous_mb()
        bank = np.load(path, mmap_mode="r")
        queries = np.random.default_rng(1).normal(size=(num_queries, bank.shape[1])).astype(np.float32)
        queries /= np.linalg.norm(queries, axis=1, keepdims=True)
        search = searcher(name, bank, k, threads)
        search(queries[:1])
        peak = anonymous_mb()["RssAnon"]
        connection.send("ready")
        times, found = [], []
        while (message := connection.recv()) != "stop":
            start = time.perf_counter()
            found.append(search(queries[message : message + 1])[0].tolist())
            times.append(time.perf_counter() - start)
            peak = max(peak, anonymous_mb()["RssAnon"])
            connection.send("done")
        start = time.perf_counter()
        search(queries[: min(32, num_queries)])
        batch = time.perf_counter() - start
        peak = max(peak, anonymous_mb()["RssAnon"])
        connection.send(
            {
                "p50_ms": float(1000 * np.percentile(times, 50)),
                "p99_ms": float(1000 * np.percentile(times, 99)),
                "ms_per_query_in_batches_of_32": 1000 * batch / min(32, num_queries),
                "anonymous_mb": peak - before["RssAnon"],
                "found": found,
            }
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--num", type=int, default=1_000_000, help="number of embeddings")
    parser.add_argument("--dim", type=int, default=512, help="dimension of the embeddings")
    parser.add_argument("--queries", type=int, default=32, help="number of queries")
    parser.add_argument("--k", type=int, default=10, help="neighbours per query")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads per engine")
    parser.add_argument("--quick", action="store_true", help="check that it runs, with 20,000 x 128 embeddings")
    parser.add_argument(
        "--bank", type=Path, help="file of the random embeddings, made if missing (default: bank-NxE.npy)"
    )
    parser.add_argument("--out", type=Path, help="write the results to this JSON file")
    options = parser.parse_args()
    if options.quick:
        options.num, options.dim = 20_000, 128
    options.bank = options.bank or Path(f"bank-{options.num}x{options.dim}.npy")
    if options.bank.exists() and (shape := np.load(options.bank, mmap_mode="r").shape) != (options.num, options.dim):
        parser.error(
            f"--bank {options.bank}: shape {shape}, expected ({options.num}, {options.dim}): delete it or choose another"
        )
    if not options.bank.exists():
        bank = np.lib.format.open_memmap(options.bank, "w+", np.float32, (options.num, options.dim))
        rng = np.random.default_rng(0)
        for start in range(0, options.num, 50_000):
            x = rng.standard_normal((min(50_000, options.num - start), options.dim), np.float32)
            bank[start : start + len(x)] = x / np.linalg.norm(x, axis=1, keepdims=True)
        bank.flush()
    context = multiprocessing.get_context("spawn")
    ends, workers = {}, []
    names = installed()
    for name in names:
        ends[name], other = context.Pipe()
        arguments = (name, str(options.bank), options.queries, options.k, options.threads, other)
        workers.append(context.Process(target=measure, args=arguments))
        workers[-1].start()
        assert ends[name].recv() == "ready"
    for query in range(options.queries):
        for end in ends.values():
            end.send(query)
            end.recv()
    result: dict[str, Any] = dict.fromkeys(ENGINES, "not installed")
    for name, end in ends.items():
        end.send("stop")
        result[name] = end.recv()
    for worker in workers:
        worker.join()
    found = {name: result[name].pop("found") for name in names}
    same = {n: float(np.mean([a == b for a, b in zip(found[OURS], found[n], strict=True)])) for n in names[1:]}
    result |= {"same_results": same, "num": options.num, "dim": options.dim, "threads": options.threads}
    result["load"] = os.getloadavg()[0]
    result |= provenance()
    print(json.dumps(result, indent=1))
    if options.out:
        options.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
