"""A map of three states for navigation: where rays of confirmed depth passed, where they ended, and what nobody saw."""
