-- Wireshark dissector of the Global Data Plane's frames (EtherType 0x88B5).
-- Made by "gdp wireshark". The tables below come from the Scapy layers; for Lua 5.1 to 5.4.

@tables@

local proto = Proto("gdp", "Global Data Plane")

local TYPES = {
  uint8 = ProtoField.uint8, uint16 = ProtoField.uint16, uint24 = ProtoField.uint24,
  uint32 = ProtoField.uint32, uint64 = ProtoField.uint64,
}

local known = {} -- ProtoFields by their filter name

local function declare(prefix, layer)
  for _, field in ipairs(layer) do
    local filter = prefix .. field.name
    if field.type == "bytes" or field.type == "name" or field.type == "rest" then
      known[filter] = ProtoField.bytes(filter, field.label)
    elseif field.type == "cbor" then
      known[filter] = ProtoField.bytes(filter, field.label)
      known[filter .. ".text"] = ProtoField.string(filter .. ".text", field.label .. " in diagnostic notation")
    else
      known[filter] = TYPES[field.type](filter, field.label, field.hex and base.HEX or base.DEC, field.values)
      for bit, flag in ipairs(field.flags or {}) do
        known[filter .. "." .. flag] = ProtoField.bool(filter .. "." .. flag, flag, 8, nil, 2 ^ (bit - 1))
      end
      if field.hops then
        known[filter .. ".left"] = ProtoField.uint8(filter .. ".left", "hops", base.DEC, nil, HOPS_MASK)
        known[filter .. ".second_path"] = ProtoField.bool(filter .. ".second_path", "second path", 8, nil, SECOND_PATH)
      end
    end
  end
end

declare("gdp.", HEADER)
for _, layer in pairs(LAYERS) do
  declare("gdp." .. layer.prefix .. ".", layer)
end
declare("gdp.statement.", STATEMENT)
known["gdp.payload"] = ProtoField.bytes("gdp.payload", "payload")
known["gdp.padding"] = ProtoField.bytes("gdp.padding", "Ethernet padding")
known["gdp.malformed.reason"] = ProtoField.string("gdp.malformed.reason", "malformed")

declare("gdp_opened.", OPENED)
for _, layer in pairs(BODIES) do
  declare("gdp_opened." .. layer.prefix .. ".", layer)
end
known["gdp_opened.body"] = ProtoField.bytes("gdp_opened.body", "body")

-- what "gdp decrypt-pcap" writes; Wireshark finds it by this name
local opened = Proto("gdp_opened", "Global Data Plane, opened")
local own, of_opened = {}, {}
for filter, field in pairs(known) do
  local list = filter:find("^gdp_opened") and of_opened or own
  list[#list + 1] = field
end
proto.fields = own
opened.fields = of_opened

local malformed = ProtoExpert.new("gdp.malformed", "malformed", expert.group.MALFORMED, expert.severity.ERROR)
local cut = ProtoExpert.new("gdp.cut", "cut by the capture", expert.group.UNDECODED, expert.severity.NOTE)
proto.experts = { malformed, cut }

-- CBOR: what gdp/frame/diagnostic.py accepts and shows. Positions count from 1; nil: not valid.

local function number_of(data, at, size)
  local value = 0
  for index = at, at + size - 1 do
    value = value * 256 + data:byte(index)
  end
  return value
end

-- decimal digits of an unsigned number of 64 bits and an addend of 0 or 1; doubles hold 53 bits only
local function digits_of(high, low, addend)
  local pieces = { math.floor(high / 65536), high % 65536, math.floor(low / 65536), low % 65536 + addend }
  local digits = ""
  repeat
    local rest, left = 0, 0
    for index = 1, 4 do
      local value = rest * 65536 + pieces[index]
      pieces[index] = math.floor(value / 10)
      rest = value % 10
      left = left + pieces[index]
    end
    digits = string.format("%d", rest) .. digits
  until left == 0
  return digits
end

-- major type, argument, argument as text, the same plus one, first position of the content, bytes of the argument
local function head(data, at)
  if at > #data then
    return nil
  end
  local first = data:byte(at)
  local major, small = math.floor(first / 32), first % 32
  if small < 24 then
    return major, small, string.format("%d", small), string.format("%d", small + 1), at + 1, 0
  end
  local size = ({ [24] = 1, [25] = 2, [26] = 4, [27] = 8 })[small]
  if size == nil or at + size > #data then
    return nil
  end
  if size < 8 then
    local value = number_of(data, at + 1, size)
    return major, value, string.format("%d", value), string.format("%d", value + 1), at + 1 + size, size
  end
  local high, low = number_of(data, at + 1, 4), number_of(data, at + 5, 4)
  return major, high * 4294967296.0 + low, digits_of(high, low, 0), digits_of(high, low, 1), at + 9, size
end

local function hex(data)
  return (data:gsub(".", function(char) return string.format("%02x", char:byte()) end))
end

-- the code points of strict UTF-8
local function code_points(data)
  local points, at = {}, 1
  while at <= #data do
    local first = data:byte(at)
    local size, value, least
    if first < 0x80 then
      size, value, least = 1, first, 0
    elseif first >= 0xC2 and first < 0xE0 then
      size, value, least = 2, first - 0xC0, 0x80
    elseif first >= 0xE0 and first < 0xF0 then
      size, value, least = 3, first - 0xE0, 0x800
    elseif first >= 0xF0 and first < 0xF5 then
      size, value, least = 4, first - 0xF0, 0x10000
    else
      return nil
    end
    if at + size - 1 > #data then
      return nil
    end
    for index = at + 1, at + size - 1 do
      local byte = data:byte(index)
      if byte < 0x80 or byte > 0xBF then
        return nil
      end
      value = value * 64 + byte - 0x80
    end
    if value < least or value > 0x10FFFF or (value >= 0xD800 and value <= 0xDFFF) then
      return nil
    end
    points[#points + 1] = value
    at = at + size
  end
  return points
end

local SHORT = { [8] = "\\b", [9] = "\\t", [10] = "\\n", [12] = "\\f", [13] = "\\r", [34] = '\\"', [92] = "\\\\" }

-- a JSON string in ASCII
local function quoted(data)
  local points = code_points(data)
  if points == nil then
    return nil
  end
  local out = {}
  for _, point in ipairs(points) do
    if SHORT[point] then
      out[#out + 1] = SHORT[point]
    elseif point >= 32 and point < 127 then
      out[#out + 1] = string.char(point)
    elseif point < 0x10000 then
      out[#out + 1] = string.format("\\u%04x", point)
    else
      local rest = point - 0x10000
      out[#out + 1] = string.format("\\u%04x\\u%04x", 0xD800 + math.floor(rest / 1024), 0xDC00 + rest % 1024)
    end
  end
  return '"' .. table.concat(out) .. '"'
end

-- decimal digits plus or minus one in the last place; nil where that needs another digit
local function stepped(digits, step)
  local out, carry = {}, step
  for index = #digits, 1, -1 do
    local value = digits:byte(index) - 48 + carry
    carry = value > 9 and 1 or value < 0 and -1 or 0
    out[index] = string.char(48 + value % 10)
  end
  return carry == 0 and table.concat(out) or nil
end

-- a number in the shortest form that reads back as the same, as Python shows it
local function shortest(value)
  if value ~= value then
    return "nan"
  elseif value == math.huge or value == -math.huge then
    return value > 0 and "inf" or "-inf"
  end
  local sign, figures, power
  for precision = 0, 16 do
    local text = string.format("%." .. precision .. "e", value)
    local minus, first, others, exponent = text:match("^(%-?)(%d)%.?(%d*)e([%+%-]%d+)$")
    sign, power = minus, tonumber(exponent)
    figures = nil
    for _, step in ipairs({ 0, 1, -1 }) do -- next to a power of two, the nearest of so many digits may not be the right one
      local tried = stepped(first .. others, step)
      if tried and tonumber(string.format("%s%se%d", sign, tried, power - precision)) == value then
        figures = tried
        break
      end
    end
    if figures then
      break
    end
  end
  local lead, behind = figures:sub(1, 1), figures:sub(2)
  if power < -4 or power >= 16 then
    local shown = behind == "" and lead or lead .. "." .. behind
    return sign .. shown .. "e" .. string.format(power < 0 and "-%02d" or "+%02d", math.abs(power))
  elseif power < 0 then
    return sign .. "0." .. string.rep("0", -power - 1) .. figures
  end
  if #figures <= power + 1 then
    return sign .. figures .. string.rep("0", power + 1 - #figures) .. ".0"
  end
  return sign .. figures:sub(1, power + 1) .. "." .. figures:sub(power + 2)
end

local FLOATS = { [2] = { 5, 10 }, [4] = { 8, 23 }, [8] = { 11, 52 } } -- bits of exponent and fraction, by bytes

local function float_of(data)
  local bits = FLOATS[#data]
  local high = data:byte(1)
  local sign = high >= 128 and -1 or 1
  local top_bits = 7 -- of the exponent and fraction in the first byte
  local value = high % 128
  local exponent_bits = bits[1]
  local exponent, fraction
  if exponent_bits < top_bits then
    local rest = 2 ^ (top_bits - exponent_bits)
    exponent, fraction = math.floor(value / rest), value % rest
  else
    local second, spare = data:byte(2), 8 - (exponent_bits - top_bits)
    exponent = value * 2 ^ (exponent_bits - top_bits) + math.floor(second / 2 ^ spare)
    fraction = second % 2 ^ spare
  end
  for index = exponent_bits < top_bits and 2 or 3, #data do
    fraction = fraction * 256 + data:byte(index)
  end
  local bias = 2 ^ (exponent_bits - 1) - 1
  if exponent == 2 ^ exponent_bits - 1 then
    return fraction == 0 and sign * math.huge or 0 / 0
  elseif exponent == 0 then
    return sign * fraction * 2.0 ^ (1 - bias - bits[2])
  end
  return sign * (2.0 ^ bits[2] + fraction) * 2.0 ^ (exponent - bias - bits[2])
end

local SIMPLE = { [20] = "false", [21] = "true", [22] = "null" }
local item

local function bytes_shown(piece, depth)
  local major = #piece > 1 and math.floor(piece:byte(1) / 32) or -1
  if major == 5 or major == 6 then
    local text, past = item(piece, 1, depth + 1)
    if text ~= nil and past == #piece + 1 then
      return "<<" .. text .. ">>"
    end
  end
  if #piece <= SHOWN_BYTES then
    return "h'" .. hex(piece) .. "'"
  end
  return string.format("h'%s\226\128\166' (%d bytes)", hex(piece:sub(1, 8)), #piece)
end

-- the text of the item at a position, and the position past it
item = function(data, at, depth)
  if depth > CBOR_DEPTH_MAX then
    return nil
  end
  local major, argument, text, more, content, size = head(data, at)
  if major == nil then
    return nil
  elseif major == 0 then
    return text, content
  elseif major == 1 then
    return "-" .. more, content
  elseif major == 2 or major == 3 then
    local past = content + argument
    if past > #data + 1 then
      return nil
    end
    local piece = data:sub(content, past - 1)
    local shown
    if major == 2 then
      shown = bytes_shown(piece, depth)
    else
      shown = quoted(piece)
    end
    return shown, past
  elseif major == 6 then
    local inside, past = item(data, content, depth + 1)
    return inside and text .. "(" .. inside .. ")", past
  elseif major == 7 then
    if FLOATS[size] then
      return shortest(float_of(data:sub(at + 1, content - 1))), content
    end
    return size == 0 and SIMPLE[argument] or nil, content
  end
  if argument > #data - content + 1 then
    return nil
  end
  local texts, past = {}, content
  for index = 1, argument do
    local one
    one, past = item(data, past, depth + 1)
    if one == nil then
      return nil
    end
    if major == 5 then
      local value
      value, past = item(data, past, depth + 1)
      if value == nil then
        return nil
      end
      one = one .. ": " .. value
    end
    texts[index] = one
  end
  local inside = table.concat(texts, ", ")
  return major == 5 and "{" .. inside .. "}" or "[" .. inside .. "]", past
end

local function diagnose(data)
  if #data > CONTROL_MAX_BYTES then
    return nil
  end
  local text, past = item(data, 1, 0)
  return past == #data + 1 and text or nil
end

-- first position of a byte string's content, and the position past it
local function byte_string(data, at)
  local major, length, _, _, content = head(data, at)
  if major ~= 2 or content + length > #data + 1 then
    return nil
  end
  return content, content + length
end

-- where the parts of a statement begin and end, or nil
local function statement_places(data)
  if data:sub(1, 2) ~= "\210\132" or diagnose(data) == nil then
    return nil
  end
  local places, at = {}, 3
  for index, name in ipairs({ "protected", "body", "signature" }) do
    local first, past = byte_string(data, at)
    if first == nil then
      return nil
    end
    places[name] = { first, past }
    at = past
    if index == 1 then
      if data:sub(at, at) ~= "\160" then
        return nil
      end
      at = at + 1
    end
  end
  return at == #data + 1 and places or nil
end

-- display

local function add(tree, filter, field, tvb, at, size)
  local range = tvb(at, size)
  local node = tree:add(known[filter], range)
  for _, flag in ipairs(field.flags or {}) do
    node:add(known[filter .. "." .. flag], range)
  end
  if field.hops then
    node:add(known[filter .. ".left"], range)
    node:add(known[filter .. ".second_path"], range)
  end
end

local function add_layer(tree, prefix, layer, tvb, at, size)
  local fixed = 0
  for _, field in ipairs(layer) do
    fixed = fixed + (field.type == "rest" and 0 or field.size)
  end
  local start = at
  for _, field in ipairs(layer) do
    local length = field.type == "rest" and size - fixed or field.size
    if length > 0 then
      add(tree, prefix .. field.name, field, tvb, at, length)
    end
    at = at + length
  end
  return at - start
end

local function add_statement(tree, tvb, at, data, places)
  for _, field in ipairs(STATEMENT) do
    local place = places[field.name]
    local filter = "gdp.statement." .. field.name
    if place == nil then
      local offset = field.name == "cose" and 0 or places.protected[2] - 1
      tree:add(known[filter], tvb(at + offset, field.size))
    elseif place[2] > place[1] then
      local content = data:sub(place[1], place[2] - 1)
      local range = tvb(at + place[1] - 1, #content)
      local node = tree:add(known[filter], range)
      node:add(known[filter .. ".text"], range, diagnose(content) or "h'" .. hex(content) .. "'")
    end
  end
end

-- returns nil where the payload has the form of its kind, else what is wrong
local function add_payload(tree, tvb, size, kind, flags, parts)
  local at, shown = HEADER_BYTES, 0
  local fault
  if STATEMENTS[kind] then
    if parts == 1 then
      local data = tvb:raw(at, size)
      local places = statement_places(data)
      if places then
        add_statement(tree:add(proto, tvb(at, size), "Statement"), tvb, at, data, places)
        return nil
      end
      fault = "no statement"
    end
  elseif PAYLOADS[kind] then
    local layer = LAYERS[PAYLOADS[kind][flags % 2 + 1]]
    if size >= layer.least then
      shown = add_layer(tree:add(proto, tvb(at, size), layer.title), "gdp." .. layer.prefix .. ".", layer, tvb, at, size)
    else
      fault = "shorter than the payload of its kind"
    end
  end
  if size > shown then
    tree:add(known["gdp.payload"], tvb(at + shown, size - shown))
  end
  return fault
end

local function mark(tree, range, reason)
  tree:add(known["gdp.malformed.reason"], range, reason):set_generated()
  tree:add_proto_expert_info(malformed, "malformed: " .. reason)
end

local function short_name(tvb, at)
  return hex(tvb:raw(at, 4))
end

function proto.dissector(tvb, pinfo, root)
  local here = tvb:len()
  local is_cut = tvb:reported_len() > here
  pinfo.cols.protocol = "GDP"
  local tree = root:add(proto, tvb())
  if here < HEADER_BYTES then
    pinfo.cols.info = "shorter than a header"
    if here > 0 then
      tree:add(known["gdp.payload"], tvb())
    end
    if is_cut then
      tree:add_proto_expert_info(cut)
    else
      mark(tree, tvb(), "shorter than a header")
    end
    return here
  end
  local at = 0
  local place = {}
  for _, field in ipairs(HEADER) do
    add(tree, "gdp." .. field.name, field, tvb, at, field.size)
    place[field.name] = at
    at = at + field.size
  end
  local version, kind = tvb(place.version, 1):uint(), tvb(place.kind, 1):uint()
  local flags, hops = tvb(place.flags, 1):uint(), tvb(place.hops_left, 1):uint()
  local length, part, parts = tvb(place.length, 2):uint(), tvb(place.part, 4):uint(), tvb(place.parts, 3):uint()
  local number = tostring(tvb(place.number, 8):uint64())
  local source, destination = short_name(tvb, place.source), short_name(tvb, place.destination)
  local size = math.min(length, here - HEADER_BYTES)
  local fault
  if version == VERSION then
    fault = add_payload(tree, tvb, size, kind, flags, parts)
  elseif size > 0 then
    tree:add(known["gdp.payload"], tvb(HEADER_BYTES, size))
  end
  if here > HEADER_BYTES + size then
    tree:add(known["gdp.padding"], tvb(HEADER_BYTES + size))
  end
  pinfo.cols.info = string.format("%s %s > %s #%s %.0f/%.0f hops %d%s", KINDS[kind] or string.format("kind 0x%02x", kind),
    source, destination, number, part + 1, parts, hops % 128, hops >= SECOND_PATH and " (second path)" or "")
  if version ~= VERSION then
    mark(tree, tvb(place.version, 1), "another version")
  elseif size < length and is_cut then
    tree:add_proto_expert_info(cut)
  elseif size < length then
    mark(tree, tvb(place.length, 2), "shorter than its payload length")
  elseif part >= parts or parts > PARTS_MAX then
    mark(tree, tvb(place.part, 8), "an impossible part")
  elseif fault then
    mark(tree, tvb(place.kind, 1), fault)
  end
  return here
end

function opened.dissector(tvb, pinfo, root)
  local here = tvb:len()
  local tree = root:add(opened, tvb())
  local place, at = {}, 0
  for _, field in ipairs(OPENED) do
    place[field.name] = at
    at = at + field.size
  end
  if here < at then
    pinfo.cols.protocol, pinfo.cols.info = "GDP opened", "shorter than its head"
    return here
  end
  add_layer(tree, "gdp_opened.", OPENED, tvb, 0, at)
  local kind, encoding = tvb(place.kind, 1):uint(), tvb(place.encoding, 1):uint()
  local layer = BODIES[kind]
  local size = here - at
  local name = KINDS[kind] or string.format("kind 0x%02x", kind)
  if layer and size >= layer.least and (kind ~= DATA or encoding > 0) then
    add_layer(tree:add(opened, tvb(at, size), layer.title), "gdp_opened." .. layer.prefix .. ".", layer, tvb, at, size)
    local body = at + layer.least
    local is_plain = kind == DATA and tvb(at + 1, 1):uint() == 0 and tvb:reported_len() == here and here > body
    local inner = is_plain and ({ "json", "cbor" })[encoding]
    if inner then
      Dissector.get(inner):call(tvb(body):tvb(), pinfo, root)
    end
  elseif size > 0 then
    tree:add(known["gdp_opened.body"], tvb(at, size))
  end
  pinfo.cols.protocol = "GDP opened"
  pinfo.cols.info = string.format("%s %s > %s #%s sequence %s, %.0f bytes", name, short_name(tvb, place.source),
    short_name(tvb, place.topic), tostring(tvb(place.number, 8):uint64()), tostring(tvb(place.sequence, 8):uint64()),
    tvb:reported_len() - at)
  return here
end

DissectorTable.get("ethertype"):add(ETHERTYPE, proto)
