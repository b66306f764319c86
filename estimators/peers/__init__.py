"""Other people's filters as rows."""
