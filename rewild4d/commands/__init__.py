"""One file a command: flags in, callables called, results printed."""
