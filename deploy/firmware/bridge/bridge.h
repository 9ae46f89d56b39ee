/* Reference sketch of a bridge: BioTacs on SPI to packets on a line (palpate's format D).
 *
 * Plain C99 without libc: give it four functions, call bridge_start once and bridge_poll in a loop.
 * The page behind it is palpate's hardware reference, sections 1.1 to 1.7 and 2.6.
 */
#ifndef PALPATE_BRIDGE_H
#define PALPATE_BRIDGE_H

#include <stddef.h>
#include <stdint.h>

#define BRIDGE_FINGERS_MAX 5
#define BRIDGE_SLOTS_MAX 44 /* of a packet; 22 to 44 are meant, 5 to 10 ms at 4400 slots/s */
#define BRIDGE_SLOTS_PER_FRAME 44
#define BRIDGE_SLOT_RATE_HZ 4400

#define BRIDGE_SERIAL_BYTES 16
#define BRIDGE_FIRMWARE_BYTES 4

/* Longest packet: header, count and fingers, slots, CRC; stuffed it is 3 bytes longer, with its end. */
#define BRIDGE_PACKET_BYTES (10 + 2 + BRIDGE_SLOTS_MAX * (1 + 2 * BRIDGE_FINGERS_MAX) + 2)
#define BRIDGE_WIRE_BYTES (BRIDGE_PACKET_BYTES + BRIDGE_PACKET_BYTES / 254 + 2)

/* The hardware. `context` is handed to each function. */
struct bridge_port {
    /* Clock one byte out and one in: mode 0, MSB first, 0.5 to 10 MHz. */
    uint8_t (*transfer)(void *context, uint8_t out);
    /* Drive the /CS of one finger, from 0: low if active, else high. */
    void (*select)(void *context, uint8_t finger, uint8_t active);
    /* Microseconds of a counter that wraps at 2^32. */
    uint32_t (*micros)(void *context);
    /* Take all bytes (not 0) or none (0), without waiting; they are the caller's afterwards. */
    int (*write)(void *context, const uint8_t *bytes, size_t count);
    void *context;
};

/* All state; nothing in it is for users. */
struct bridge {
    struct bridge_port port;
    uint8_t source, fingers, slots_per_packet;
    uint16_t slot_rate_hz;

    uint8_t serials[BRIDGE_FINGERS_MAX][BRIDGE_SERIAL_BYTES];
    uint8_t firmwares[BRIDGE_FINGERS_MAX][BRIDGE_FIRMWARE_BYTES];

    uint32_t slot_us;      /* when the next slot is due */
    uint32_t slot_rest;    /* and its fraction, in 1 / slot_rate_hz us */
    uint32_t hello_us, status_us;
    uint8_t position;      /* of the next slot in the frame */
    uint8_t gathered;      /* slots of the packet that has begun */
    uint16_t sequence;     /* of the next packet */

    uint32_t parity_errors[BRIDGE_FINGERS_MAX];
    uint32_t error_words;
    uint32_t overruns;     /* slots that were dropped */

    uint16_t crc;
    uint16_t length, code_at; /* of `wire`; place of the code that counts to the next zero */
    uint8_t wire[BRIDGE_WIRE_BYTES];
};

/* Ask the fingers who they are, and begin.
 *
 * source            this bridge's id, if several share a host
 * fingers           1 to BRIDGE_FINGERS_MAX
 * slot_rate_hz      1 to 65535, as far as the SPI can follow; BRIDGE_SLOT_RATE_HZ is the maker's
 * slots_per_packet  1 to BRIDGE_SLOTS_MAX
 *
 * Numbers out of range are moved to its nearer end.
 */
void bridge_start(struct bridge *bridge, const struct bridge_port *port, uint8_t source,
                  uint8_t fingers, uint16_t slot_rate_hz, uint8_t slots_per_packet);

/* Sample the slot that is due, if one is; send the packet that it fills. Call it without pause. */
void bridge_poll(struct bridge *bridge);

#endif
