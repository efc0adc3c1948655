"""The `pisigma` command, with a short file per subcommand; heavy packages are imported inside the commands."""
