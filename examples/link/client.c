/* A client of `thermorender serve` without a library: flies straight ahead, looks down, writes the last frame.
 *
 *     cc -std=c99 -O2 -o client client.c
 *     ./client 127.0.0.1 47800 TOKEN_FILE 30 last.pgm
 *
 * The messages are those of docs/reference/link.md. Numbers are put together byte by byte, so the order of bytes in this
 * machine does not matter; doubles are IEEE 754.
 */
#define _POSIX_C_SOURCE 200112L
#include <netdb.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

enum { HELLO = 1, OPEN = 3, REQUEST = 5, ERROR = 9, COUNTS = 1, HEADER = 24 };

static int server;

static void fail(const char *what)
{
    fprintf(stderr, "error: %s\n", what);
    exit(2);
}

static uint8_t *put(uint8_t *at, uint64_t value, int bytes)
{
    for (int i = 0; i < bytes; i++) *at++ = (uint8_t)(value >> 8 * i);
    return at;
}

static uint8_t *put_double(uint8_t *at, double value)
{
    uint64_t bits;
    memcpy(&bits, &value, 8);
    return put(at, bits, 8);
}

static uint64_t get(const uint8_t *at, int bytes)
{
    uint64_t value = 0;
    for (int i = 0; i < bytes; i++) value |= (uint64_t)at[i] << 8 * i;
    return value;
}

static void send_message(int type, uint32_t session, uint64_t id, const uint8_t *payload, uint32_t length)
{
    uint8_t data[HEADER + 1024], *at = data;
    memcpy(at, "TRLK", 4);
    at = put(at + 4, 1, 2);
    at = put(at, (uint64_t)type, 2);
    at = put(at, length, 4);
    at = put(at, session, 4);
    at = put(at, id, 8);
    memcpy(at, payload, length);
    for (size_t sent = 0, total = HEADER + length; sent < total;) {
        ssize_t got = send(server, data + sent, total - sent, 0);
        if (got <= 0) fail("the connection is lost");
        sent += (size_t)got;
    }
}

static void read_exactly(uint8_t *at, size_t length)
{
    while (length) {
        ssize_t got = recv(server, at, length, 0);
        if (got <= 0) fail("the server closed the connection");
        at += got;
        length -= (size_t)got;
    }
}

/* The payload of the next message, to be freed; the server's error ends the program. */
static uint8_t *receive(void)
{
    uint8_t head[HEADER], *payload;
    read_exactly(head, HEADER);
    size_t length = get(head + 8, 4);
    if (memcmp(head, "TRLK", 4) || !(payload = malloc(length + 1))) fail("this is not the link, or memory is short");
    read_exactly(payload, length);
    payload[length] = 0;
    if (get(head + 6, 2) == ERROR) fail((const char *)payload + 4);
    return payload;
}

int main(int count, char **argument)
{
    if (count != 6) fail("give HOST PORT TOKEN_FILE FRAMES IMAGE.pgm");
    struct addrinfo hints = {.ai_socktype = SOCK_STREAM}, *found;
    if (getaddrinfo(argument[1], argument[2], &hints, &found)) fail("the host is unknown");
    server = socket(found->ai_family, found->ai_socktype, found->ai_protocol);
    if (server < 0 || connect(server, found->ai_addr, found->ai_addrlen)) fail("nothing listens there");
    freeaddrinfo(found);

    char token[65] = {0};
    FILE *file = fopen(argument[3], "r");
    if (!file || fread(token, 1, 64, file) != 64) fail("the token file cannot be read");
    fclose(file);
    send_message(HELLO, 0, 1, (uint8_t *)token, 64);
    free(receive());

    /* The scene's camera, method A, positions ENU, quaternion of the camera, seed 11, 30 frames per second. */
    uint8_t settings[200] = {0};
    settings[128] = 'A';
    put(settings + 136, 11, 8);
    put_double(settings + 144, 30.0);
    send_message(OPEN, 1, 2, settings, sizeof settings);
    free(receive());

    uint8_t *reply = NULL;
    long frames = strtol(argument[4], NULL, 10);
    for (long index = 0; index < frames; index++) {
        double time_s = (double)index / 30.0;
        /* Time, east, north, up, and half a turn about east: the camera looks down with north on top. */
        double pose[8] = {time_s, 0.0, 0.5 * time_s, 12.0, 0.0, 1.0, 0.0, 0.0};
        uint8_t request[104], *at = put_double(request, time_s);
        at = put(at, COUNTS, 4);
        at = put(at, 0, 4);
        at = put(at, 1, 4); /* one pose */
        at = put(at, 0, 4);
        at = put(at, 0, 8);
        at = put_double(at, 0.0);
        for (int i = 0; i < 8; i++) at = put_double(at, pose[i]);
        send_message(REQUEST, 1, 3 + (uint64_t)index, request, sizeof request);
        free(reply);
        reply = receive();
        uint32_t pixels = (uint32_t)(get(reply + 44, 4) * get(reply + 48, 4));
        double sum = 0.0;
        for (uint32_t i = 0; i < pixels; i++) sum += (double)get(reply + 64 + 2 * i, 2);
        printf("%lu %.3f\n", (unsigned long)get(reply + 16, 8), pixels ? sum / pixels : 0.0);
    }
    if (!reply || !(file = fopen(argument[5], "wb"))) fail("there is no frame, or the image cannot be written");
    unsigned width = (unsigned)get(reply + 44, 4), height = (unsigned)get(reply + 48, 4);
    fprintf(file, "P5\n%u %u\n65535\n", width, height);
    for (size_t i = 0; i < (size_t)width * height; i++) { /* PGM has the higher byte first. */
        fputc(reply[64 + 2 * i + 1], file);
        fputc(reply[64 + 2 * i], file);
    }
    free(reply);
    return fclose(file) || close(server) ? 2 : 0;
}
