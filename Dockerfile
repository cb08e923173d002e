# The package with its models. Results are written to the folder that is mounted at /work:
#   docker build -t physion .
#   docker run --rm -v "$PWD:/work" --user "$(id -u):$(id -g)" physion run --limit 4
FROM python:3.11-slim

WORKDIR /opt/physion
COPY pyproject.toml requirements.lock README.md LICENSE ./
COPY src src
# Other extras: docker build --build-arg EXTRAS=models,weights,experiment -t physion .
ARG EXTRAS=models,weights
RUN pip install --no-cache-dir ".[$EXTRAS]" -c requirements.lock

# Compiled kernels are kept in the image; a machine with another processor compiles them again.
RUN physion generate /tmp/warm --scenario collide --count 1 --width 64 --height 64 \
    && rm -r /tmp/warm

# Any user may run it: home folders of other users are not writable.
ENV HOME=/tmp MPLCONFIGDIR=/tmp/matplotlib
WORKDIR /work
ENTRYPOINT ["physion"]
CMD ["--help"]
