"""What is timed, how, and against what: the `bench` command's inside. Runs on the CPU."""
