"""The bench: fixed suites of tasks for any encoder, one signed result per encoder, and a page that compares them."""
