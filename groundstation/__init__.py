"""What a person operates: the command line, the report and the live views."""
