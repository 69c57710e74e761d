# Sulcus on CPUs. From a clone:
#
#   docker build -t sulcus .
#   docker run --rm --user "$(id -u):$(id -g)" -v "$PWD":/data sulcus synth render tiny --out out
#
# `--user`: what is written belongs to you, whatever your number is.
# PIP_EXTRA_INDEX_URL may name an index with CPU builds of torch; the default one brings CUDA's libraries along.

FROM python:3.11-slim-trixie

# The renderer compiles its kernels with LLVM and is linked against libatomic, which slim images lack.
RUN apt-get update \
    && apt-get install -y --no-install-recommends libatomic1 libllvm19 \
    && rm -rf /var/lib/apt/lists/*

ARG PIP_EXTRA_INDEX_URL
WORKDIR /opt/sulcus
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY synth synth
COPY learn learn
COPY bench bench
RUN pip install --no-cache-dir -c constraints.txt '.[bench]' \
    && rm -rf /opt/sulcus \
    && useradd --create-home sulcus \
    && install -d -o sulcus /data

# Compiled kernels are kept below the home folder: mount one to keep them from run to run.
USER sulcus
WORKDIR /data
CMD ["synth", "--help"]
