"""What every process of the node needs: verbs, configuration files, logs, locks, signals, durable files."""
