"""Tools that read one topic or call one service through the overlay, as members with rights of their own."""
