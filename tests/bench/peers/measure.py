"""What the comparisons with peers share: the cost of a process, raw floats, and structure functions."""
import os
import subprocess

import numpy

RUNS = 3


def measured(command):
    """Least CPU seconds and peak megabytes of a command's process; None where it fails."""
    best = []
    for _ in range(RUNS):
        child = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        if child.returncode:
            return None
        best.append((usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024))
    return min(b[0] for b in best), min(b[1] for b in best)


def read_raw(path, width):
    """Rows of `width` floats as doubles."""
    return numpy.fromfile(path, dtype="<f4").reshape(-1, width).astype(float)


def increments(z, lag):
    """Differences over `lag` samples along rows, columns and both diagonals."""
    return (z[:, lag:] - z[:, :-lag], z[lag:] - z[:-lag], z[lag:, lag:] - z[:-lag, :-lag], z[lag:, :-lag] - z[:-lag, lag:])


def structure(z, lags):
    """Mean squared increments: one row a lag, one column a direction."""
    return numpy.array([[numpy.mean(d * d) for d in increments(z, lag)] for lag in lags])
