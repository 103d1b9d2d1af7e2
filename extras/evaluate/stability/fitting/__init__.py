"""The numbers of the verdict, found from raw results (windows.json, stability.json)."""
