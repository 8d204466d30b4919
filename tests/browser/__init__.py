"""What people open in a browser, opened in Chromium: the pages of ``check``, and the site."""
