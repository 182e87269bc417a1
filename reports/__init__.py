"""From stored results to HTML, JUnit and Markdown."""
