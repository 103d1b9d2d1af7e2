"""docs/configuration.md: every option of the configuration files, as the code declares and comments it."""
