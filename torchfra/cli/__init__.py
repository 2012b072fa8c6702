"""The command line: commands, their options, pages.  The library does not import it."""
