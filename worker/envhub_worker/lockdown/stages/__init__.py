"""Who locks what down, and when: zygote, jail, runner, and the test at the end."""
