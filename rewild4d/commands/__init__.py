"""Commands, a file each: parse flags, call functions, print results."""
