"""What long runs share: files written whole, checkpoints, several processes, progress bars, memory."""
