"""``tubesight reproduce``: figures and tables of Dalvand, Nahavandi & Howe 2016, measured again on rendered pictures.

Each study is one module with ``run(context) -> StudyResult``; `registry` names them, `runner` runs and reports them.
"""
