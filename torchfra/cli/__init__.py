"""The command line: evaluation, figures, files.  The library below does not import it."""
