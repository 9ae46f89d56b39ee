/* See bridge.h. A packet is stuffed and summed byte by byte as its slots come, so that no slot waits
 * for the work of a whole packet.
 */
#include "bridge.h"

enum { VERSION = 1 };
enum { HELLO = 1, SLOTS = 2, STATUS = 3 };
enum { READ_PROPERTY = 0x61, SERIAL_NUMBER = 0x15, FIRMWARE_VERSION = 0x13 };
enum { CONVERSION_US = 50, BETWEEN_FINGERS_US = 10 };
enum { HELLO_US = 500000, STATUS_US = 1000000 };
enum { PAC = 0x80, ERROR = 0xA5 };

/* Sampling commands besides PAC, which follows each: E1 to E19, PDC, TAC, TDC. */
static const uint8_t COMMANDS[BRIDGE_SLOTS_PER_FRAME / 2] = {
    0xA2, 0xA4, 0xA7, 0xA8, 0xAB, 0xAD, 0xAE, 0xB0, 0xB3, 0xB5, 0xB6,
    0xB9, 0xBA, 0xBC, 0xBF, 0xC1, 0xC2, 0xC4, 0xC7, 0x83, 0x85, 0x86,
};

/* Second bytes of error words. */
static const uint8_t ERRORS[] = {'E', '?', '.', '-', 'X', '_', 'R', 'W'};

/* ---- packets ------------------------------------------------------------------------------ */

/* COBS: each run of bytes without a zero stands behind its length and one; the longest is 254. */
static void end_run(struct bridge *b)
{
    b->wire[b->code_at] = (uint8_t)(b->length - b->code_at);
    b->code_at = b->length++;
}

static void stuff(struct bridge *b, uint8_t byte)
{
    /* A full run is ended only now: at the end of a packet it needs no other behind it. */
    if (b->length - b->code_at == 255)
        end_run(b);
    if (byte == 0)
        end_run(b);
    else
        b->wire[b->length++] = byte;
}

static void put(struct bridge *b, uint8_t byte)
{
    uint16_t crc = b->crc ^ byte; /* CRC-16/X-25: 0x1021 reflected */
    for (int bit = 0; bit < 8; bit++)
        crc = (uint16_t)((crc >> 1) ^ ((crc & 1) ? 0x8408 : 0));
    b->crc = crc;
    stuff(b, byte);
}

static void put_u16(struct bridge *b, uint16_t value)
{
    put(b, (uint8_t)value);
    put(b, (uint8_t)(value >> 8));
}

static void put_u32(struct bridge *b, uint32_t value)
{
    put_u16(b, (uint16_t)value);
    put_u16(b, (uint16_t)(value >> 16));
}

static void begin_packet(struct bridge *b, uint8_t type, uint32_t time_us)
{
    b->crc = 0xFFFF;
    b->code_at = 0;
    b->length = 1;
    put(b, VERSION);
    put(b, type);
    put(b, b->source);
    put(b, 0); /* flags */
    put_u16(b, b->sequence++);
    put_u32(b, time_us);
}

/* Nonzero if the line took it. One that it did not take has had its number: the host sees the gap. */
static int end_packet(struct bridge *b)
{
    uint16_t crc = b->crc ^ 0xFFFF;
    stuff(b, (uint8_t)crc);
    stuff(b, (uint8_t)(crc >> 8));
    end_run(b);
    b->wire[b->code_at] = 0; /* what would be the next code is the delimiter */
    return b->port.write(b->port.context, b->wire, b->length);
}

static void send_hello(struct bridge *b, uint32_t now_us)
{
    begin_packet(b, HELLO, now_us);
    put(b, b->fingers);
    put_u16(b, b->slot_rate_hz);
    put(b, BRIDGE_SLOTS_PER_FRAME);
    for (uint8_t finger = 0; finger < b->fingers; finger++) {
        for (int at = 0; at < BRIDGE_SERIAL_BYTES; at++)
            put(b, b->serials[finger][at]);
        for (int at = 0; at < BRIDGE_FIRMWARE_BYTES; at++)
            put(b, b->firmwares[finger][at]);
    }
    end_packet(b);
    b->hello_us = now_us;
}

static void send_status(struct bridge *b, uint32_t now_us)
{
    begin_packet(b, STATUS, now_us);
    put(b, b->fingers);
    for (uint8_t finger = 0; finger < b->fingers; finger++)
        put_u32(b, b->parity_errors[finger]);
    put_u32(b, b->error_words);
    put_u32(b, b->overruns);
    end_packet(b);
    b->status_us = now_us;
}

/* ---- fingers ------------------------------------------------------------------------------ */

static uint32_t now(struct bridge *b) { return b->port.micros(b->port.context); }

static void wait(struct bridge *b, uint32_t time_us)
{
    uint32_t began_us = now(b);
    /* One more: the counter may have been about to step. */
    while ((uint32_t)(now(b) - began_us) <= time_us)
        ;
}

static uint8_t transfer(struct bridge *b, uint8_t out)
{
    return b->port.transfer(b->port.context, out);
}

static void select(struct bridge *b, uint8_t finger, uint8_t active)
{
    b->port.select(b->port.context, finger, active);
}

/* Ask fingers [first, end) at once. */
static void command(struct bridge *b, uint8_t first, uint8_t end, uint8_t byte, uint8_t second)
{
    for (uint8_t finger = first; finger < end; finger++)
        select(b, finger, 1);
    transfer(b, byte);
    transfer(b, second);
    for (uint8_t finger = first; finger < end; finger++)
        select(b, finger, 0);
    wait(b, CONVERSION_US);
}

static void answer(struct bridge *b, uint8_t finger, uint8_t word[2])
{
    select(b, finger, 1);
    word[0] = transfer(b, 0);
    word[1] = transfer(b, 0);
    select(b, finger, 0);
    wait(b, BETWEEN_FINGERS_US);
}

static void read_property(struct bridge *b, uint8_t finger, uint8_t property, uint8_t *to, int count)
{
    command(b, finger, (uint8_t)(finger + 1), READ_PROPERTY, property);
    for (int at = 0; at < count; at += 2)
        answer(b, finger, to + at);
}

static int is_odd(uint8_t byte)
{
    byte ^= byte >> 4;
    byte ^= byte >> 2;
    byte ^= byte >> 1;
    return byte & 1;
}

static void count_flaws(struct bridge *b, uint8_t finger, const uint8_t word[2])
{
    if (is_odd(word[0]) && is_odd(word[1]))
        return;
    if (word[0] == word[1] && (word[0] == 0x00 || word[0] == 0xFF))
        return; /* nobody there */
    if (word[0] == ERROR) {
        for (size_t at = 0; at < sizeof ERRORS; at++) {
            if (word[1] == ERRORS[at]) {
                b->error_words++;
                return;
            }
        }
    }
    b->parity_errors[finger]++;
}

static void sample(struct bridge *b)
{
    uint8_t byte = b->position % 2 ? PAC : COMMANDS[b->position / 2];
    command(b, 0, b->fingers, byte, 0);
    put(b, byte);
    for (uint8_t finger = 0; finger < b->fingers; finger++) {
        uint8_t word[2];
        answer(b, finger, word);
        count_flaws(b, finger, word);
        put(b, word[0]); /* verbatim: the host judges */
        put(b, word[1]);
    }
}

/* ---- time --------------------------------------------------------------------------------- */

static void next_slot(struct bridge *b)
{
    b->slot_us += 1000000u / b->slot_rate_hz;
    b->slot_rest += 1000000u % b->slot_rate_hz;
    if (b->slot_rest >= b->slot_rate_hz) {
        b->slot_rest -= b->slot_rate_hz;
        b->slot_us++;
    }
    b->position = (uint8_t)((b->position + 1) % BRIDGE_SLOTS_PER_FRAME);
}

/* Slots of a packet stand on one grid, so one that came too late takes the packet with it. */
static void catch_up(struct bridge *b, uint32_t now_us)
{
    uint32_t period_us = 1000000u / b->slot_rate_hz + 1;
    if ((uint32_t)(now_us - b->slot_us) < period_us)
        return;
    b->overruns += b->gathered;
    b->gathered = 0;
    while ((uint32_t)(now_us - b->slot_us) < 0x80000000u) {
        b->overruns++;
        next_slot(b);
    }
}

void bridge_poll(struct bridge *b)
{
    uint32_t now_us = now(b);
    if ((uint32_t)(now_us - b->slot_us) >= 0x80000000u)
        return; /* not yet due */
    catch_up(b, now_us);
    if (b->gathered == 0) {
        if ((uint32_t)(now_us - b->hello_us) >= HELLO_US)
            send_hello(b, now_us);
        if ((uint32_t)(now_us - b->status_us) >= STATUS_US)
            send_status(b, now_us);
    }
    if ((uint32_t)(now_us - b->slot_us) >= 0x80000000u)
        return; /* it had to be dropped */
    if (b->gathered == 0) {
        begin_packet(b, SLOTS, b->slot_us);
        put(b, b->slots_per_packet);
        put(b, b->fingers);
    }
    sample(b);
    next_slot(b);
    if (++b->gathered == b->slots_per_packet) {
        if (!end_packet(b))
            b->overruns += b->gathered;
        b->gathered = 0;
    }
}

static uint16_t within(uint16_t value, uint16_t most)
{
    return value < 1 ? 1 : value > most ? most : value;
}

void bridge_start(struct bridge *b, const struct bridge_port *port, uint8_t source, uint8_t fingers,
                  uint16_t slot_rate_hz, uint8_t slots_per_packet)
{
    static const uint8_t end[1] = {0};
    b->port = *port;
    b->source = source;
    b->fingers = (uint8_t)within(fingers, BRIDGE_FINGERS_MAX);
    b->slot_rate_hz = within(slot_rate_hz, 0xFFFF);
    b->slots_per_packet = (uint8_t)within(slots_per_packet, BRIDGE_SLOTS_MAX);
    b->position = b->gathered = 0;
    b->sequence = 0;
    b->slot_rest = 0;
    b->error_words = b->overruns = 0;
    for (uint8_t finger = 0; finger < b->fingers; finger++) {
        b->parity_errors[finger] = 0;
        select(b, finger, 0);
    }
    for (uint8_t finger = 0; finger < b->fingers; finger++) {
        read_property(b, finger, SERIAL_NUMBER, b->serials[finger], BRIDGE_SERIAL_BYTES);
        read_property(b, finger, FIRMWARE_VERSION, b->firmwares[finger], BRIDGE_FIRMWARE_BYTES);
    }
    b->port.write(b->port.context, end, 1); /* ends whatever noise the start has made */
    b->status_us = now(b);
    send_hello(b, b->status_us);
    b->slot_us = now(b);
}
