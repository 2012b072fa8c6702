"""Tools of long runs: atomic writing of files, checkpoints, several processes, progress bars, memory."""
