"""The paper's tasks as environments that simulate many trunks at once, their parameters drawn at every reset."""
