"""Pages made from the code: docs/configuration.md has every option, docs/api.md the names of `import splatnode`."""
