# Sulcus on CPUs. From a clone:
#
#   docker build -t sulcus .
#   docker run --rm --user "$(id -u):$(id -g)" -v "$PWD":/data sulcus synth render tiny --out out
#
# `--user`: files that are written belong to you.
# PIP_EXTRA_INDEX_URL may name an index with CPU builds of torch; builds of the default index include CUDA.

FROM python:3.11-slim-trixie

# The renderer is linked against libatomic, which slim images lack; its LLVM is a Python package.
RUN apt-get update \
    && apt-get install -y --no-install-recommends libatomic1 \
    && rm -rf /var/lib/apt/lists/*

ARG PIP_EXTRA_INDEX_URL
WORKDIR /opt/sulcus
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY synth synth
COPY learn learn
COPY bench bench
RUN pip install --no-cache-dir -c constraints.txt '.[bench]' \
    && rm -rf /opt/sulcus \
    && python -c '' \
    && useradd --create-home sulcus \
    && install -d -o sulcus /data

# Compiled kernels are cached in the home folder: mount one to reuse them in later runs.
USER sulcus
WORKDIR /data
CMD ["synth", "--help"]
