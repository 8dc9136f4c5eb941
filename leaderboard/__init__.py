"""What was found: records first, tables after."""
