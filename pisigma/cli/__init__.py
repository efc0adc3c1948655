"""The `pisigma` command: one short file per subcommand; heavy packages are imported inside the commands."""
