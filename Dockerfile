# The calibration demo on a CPU:
#     docker build -t rfdropo_bayes . && docker run --rm -v "$PWD/reports:/app/reports" rfdropo_bayes
FROM python:3.11-slim
RUN useradd --create-home lab && mkdir /app && chown lab /app
WORKDIR /app
USER lab
COPY --chown=lab . .
RUN python -m venv .venv \
    && .venv/bin/pip install --no-cache-dir --disable-pip-version-check --constraint constraints.txt .
ENV PATH=/app/.venv/bin:$PATH OPENBLAS_NUM_THREADS=1
CMD ["rfdropo", "calibrate", "experiments/demo.toml", "--out", "runs/demo", "--overwrite"]
