"""``python -m onboard``. An interrupt ends it with code 130; what was recorded until then is a complete log."""

try:
    from onboard.main import main

    code = main()
except KeyboardInterrupt:
    code = 130
raise SystemExit(code)
