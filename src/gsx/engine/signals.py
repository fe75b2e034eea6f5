"""Signals that end a process which trains."""

import signal

STOPPING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGUSR2", "SIGHUP") if hasattr(signal, name))
"""Signals of the end of a job: preempted or requeued; out of time (submitit asks Slurm for it); its terminal closed."""
INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells report it."""


def handled_signals() -> list[signal.Signals]:
    """Lists the signals of STOPPING that end training, without those that `nohup` has set to be ignored."""
    return [number for number in STOPPING if signal.getsignal(number) != signal.SIG_IGN]
