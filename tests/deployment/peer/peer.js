/* A CANopen slave that shares no line with rfdropo_bayes: the npm package `canopen` (CiA 301: NMT, heartbeat, SDO server,
 * PDOs on SYNC, emergencies) on our hub. What CiA 402 asks of the application (states, motion) is the few lines below.
 *
 *     node peer.js HOST PORT NODE EDS
 */
const fs = require('fs');
const net = require('net');
const Module = require('module');

// Block transfers alone need this native module; nobody here sends any.
const load = Module._load;
Module._load = function (name, ...rest) {
    return name === 'node-crc' ? { crc: () => { throw new Error('no block transfers'); } } : load.call(this, name, ...rest);
};
const { Device, Eds } = require('canopen');

const [host, port, node, file] = process.argv.slice(2);
const id = Number(node);

// The package takes no $NODEID, nor the access type "rww".
const text = fs.readFileSync(file, 'utf8')
    .replace(/\$NODEID\+(0x[0-9A-Fa-f]+)/g, (_, base) => '0x' + (Number(base) + id >>> 0).toString(16))
    .replace(/AccessType=rww/g, 'AccessType=rw');
const own = `${process.env.TMPDIR || '/tmp'}/peer-${process.pid}.eds`;
fs.writeFileSync(own, text);
const eds = Eds.fromFile(own);
fs.unlinkSync(own);

const device = new Device({ eds, id });
const socket = net.connect(Number(port), host);
socket.setNoDelay(true);

// struct can_frame, little-endian
device.addListener('message', ({ id, data }) => {
    const frame = Buffer.alloc(16);
    frame.writeUInt32LE(id, 0);
    frame.writeUInt8(data ? data.length : 0, 4);
    if (data) Buffer.from(data).copy(frame, 8);
    socket.write(frame);
});
let received = Buffer.alloc(0);
socket.on('data', (chunk) => {
    received = Buffer.concat([received, chunk]);
    for (; received.length >= 16; received = received.subarray(16)) {
        const len = received.readUInt8(4);
        device.receive({ id: received.readUInt32LE(0), len, data: Buffer.from(received.subarray(8, 8 + len)) });
        obey();
    }
});
socket.on('close', () => process.exit(0));
socket.on('error', () => process.exit(1));

const get = (index) => eds.getEntry(index).value;
const set = (index, value) => { if (get(index) !== value) eds.getEntry(index).value = value; };

// CiA 402, as far as a session asks for it; written from the standard's table, not from ours.
let word = 0;
set(0x6041, 0x0040);
function obey() {
    const now = get(0x6040), before = word, state = get(0x6041) & 0x6f;
    word = now;
    set(0x6061, get(0x6060));
    const shutdown = (now & 0x87) === 0x06, on = (now & 0x8f) === 0x07, enable = (now & 0x8f) === 0x0f;
    const off = (now & 0x82) === 0x00, stop = (now & 0x86) === 0x02;
    let next = state;
    if ((state & 0x4f) === 0x40 && shutdown) next = 0x21;
    else if (state === 0x21) next = on ? 0x23 : off || stop ? 0x40 : 0x21;
    else if (state === 0x23) next = enable ? 0x27 : shutdown ? 0x21 : off || stop ? 0x40 : 0x23;
    else if (state === 0x27) next = stop ? 0x07 : on ? 0x23 : shutdown ? 0x21 : off ? 0x40 : 0x27;
    else if (state === 0x07) next = off ? 0x40 : enable ? 0x27 : 0x07;
    else if ((state & 0x4f) === 0x08 && now & 0x80 && !(before & 0x80)) next = 0x40;
    set(0x6041, next);
    if (next === 0x27) set(0x6064, get(0x607a));
    if (get(0x2f00) === 4) { // fault on request, as the simulated drive has it
        eds.getEntry(0x2f00).value = 0;
        set(0x6041, 0x0008);
        device.emcy.write(0x2310, Buffer.alloc(5)); // (its form with an object sends code 0)
    }
}

socket.on('connect', () => {
    device.start();
    console.log('ready');
});
