#!lua name=gdp_rib
-- Routes of one name in one string: records of advertiser (32), sequence (8), end of the lease in ms (8), length (4), data.
-- A second key holds the highest sequence number of an advertiser, and outlives the route.

local function now_ms()
  local time = redis.call('TIME')
  return time[1] * 1000 + math.floor(time[2] / 1000)
end

-- 64-bit numbers are compared in halves, because numbers of Lua are doubles
local function is_below(a, b)
  local a_high, a_low = struct.unpack('>I4I4', a)
  local b_high, b_low = struct.unpack('>I4I4', b)
  return a_high < b_high or (a_high == b_high and a_low < b_low)
end

-- returns the records of the other advertisers, the latest end of their leases, and this advertiser's data and end
local function others(value, advertiser, now)
  local kept, latest, own, own_ends = {}, 0, nil, 0
  local at = 1
  while value and at <= #value do
    local record_advertiser, _, high, low, size = struct.unpack('>c32c8I4I4I4', value, at)
    local ends = high * 4294967296 + low
    local stop = at + 52 + size
    if record_advertiser == advertiser then
      own, own_ends = string.sub(value, at + 52, stop - 1), ends
    elseif ends > now then
      kept[#kept + 1] = string.sub(value, at, stop - 1)
      latest = math.max(latest, ends)
    end
    at = stop
  end
  return kept, latest, own, own_ends
end

local function store(key, records, latest)
  if #records == 0 then
    redis.call('DEL', key)
  else
    redis.call('SET', key, table.concat(records), 'PXAT', string.format('%.0f', latest))
  end
end

-- KEYS: routes of the name. Returns {present (ms), records}: what is left of a lease does not depend on the clock of a RIB.
local function get(keys)
  return {now_ms(), redis.call('GET', keys[1]) or ''}
end

-- KEYS: routes of the name, highest sequence, shared context.
-- ARGV: advertiser, sequence, lease from now on (ms), data, end of evidence (ms), context or empty, channel, message
-- Returns {1, sequence} if stored, {0, sequence} if the stored route is newer, {2, sequence} if the context is missing.
local function put(keys, argv)
  local advertiser, sequence, data, until_ms = argv[1], argv[2], argv[4], argv[5]
  local now = now_ms()
  local ends = now + tonumber(argv[3])
  local held = redis.call('GET', keys[2])
  if held and is_below(sequence, held) then
    return {0, held}
  end
  if argv[6] ~= '' then
    redis.call('SET', keys[3], argv[6], 'PXAT', until_ms)
  elseif redis.call('EXISTS', keys[3]) == 0 then
    return {2, sequence}
  else
    redis.call('PEXPIREAT', keys[3], until_ms, 'GT')
  end
  local records, latest, own, own_ends = others(redis.call('GET', keys[1]), advertiser, now)
  if held == sequence then
    if own ~= data then
      return {0, held}
    end
    ends = math.max(ends, own_ends)
  end
  local high = math.floor(ends / 4294967296)
  records[#records + 1] = struct.pack('>c32c8I4I4I4', advertiser, sequence, high, ends % 4294967296, #data) .. data
  store(keys[1], records, math.max(latest, ends))
  redis.call('SET', keys[2], sequence, 'PXAT', until_ms)
  redis.call('SPUBLISH', argv[7], argv[8])
  return {1, sequence}
end

-- KEYS: routes of the name, highest sequence. ARGV: advertiser, sequence, end of evidence (ms), channel, message
local function withdraw(keys, argv)
  local held = redis.call('GET', keys[2])
  if held and is_below(argv[2], held) then
    return {0, held}
  end
  local records, latest = others(redis.call('GET', keys[1]), argv[1], now_ms())
  store(keys[1], records, latest)
  redis.call('SET', keys[2], argv[2], 'PXAT', argv[3])
  redis.call('SPUBLISH', argv[4], argv[5])
  return {1, argv[2]}
end

redis.register_function{function_name = 'gdp_rib_get', callback = get, flags = {'no-writes'}}
redis.register_function('gdp_rib_put', put)
redis.register_function('gdp_rib_withdraw', withdraw)
