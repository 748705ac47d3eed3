# docker build -t pharos . && docker run --rm -it -v "$PWD/out:/work" pharos hardness breakout/12x8x1
# Build argument EXTRAS: what beyond the core comes in, such as --build-arg EXTRAS=[agents] (PyTorch of CPUs alone).
FROM python:3.13-slim
ARG EXTRAS=""
COPY . /source
RUN case "$EXTRAS" in *agents*) pip install --no-cache-dir torch --index-url https://download.pytorch.org/whl/cpu;; esac \
    && pip install --no-cache-dir "/source$EXTRAS" -c /source/constraints.txt && rm -rf /source \
    && useradd --create-home pharos && mkdir /work && chown pharos /work
USER pharos
WORKDIR /work
ENTRYPOINT ["pharos"]
CMD ["list"]
