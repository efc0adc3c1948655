"""The `pisigma` command: one file a subcommand, each thin; what is heavy is imported inside the commands."""
